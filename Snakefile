# The order of the notebooks: one rule a notebook. What shapes a step's result stands in its params, as digests,
# so that a changed setting or changed code reruns the step and what depends on it, and nothing else.
import os

from dualdepth.results import Run, code_digest, notebook_digest

PROFILE = config.get("profile", "tiny")
run_ = Run(PROFILE)
NAME = run_.profile.name
SEEDS = [int(s) for s in str(config.get("seeds", "")).split(",") if s] or run_.profile.seeds
WORK, RESULTS = f"work/{NAME}", f"results/{NAME}"
ONE_AT_A_TIME = workflow.cores  # a training uses all cores


def notebook(name):
    """Digest of a notebook's own cells."""
    return notebook_digest(name)


rule all:
    input:
        f"{RESULTS}/notebooks/00_quickstart.ipynb",
        f"{RESULTS}/notebooks/05_table_main.ipynb",


rule quickstart:
    output:
        f"{RESULTS}/notebooks/00_quickstart.ipynb",
    params:
        notebook=notebook("00_quickstart"),
        code=code_digest("train", "world"),
    shell:
        "dualdepth notebook 00_quickstart --out {output} --set profile={PROFILE:q}"


rule download_data:
    output:
        notebook=f"{RESULTS}/notebooks/01_download_data.ipynb",
        sources=f"{WORK}/sources.json",
    params:
        notebook=notebook("01_download_data"),
        settings=run_.profile.digest("world", "data"),
        code=code_digest("world"),
        kitti_root=config.get("kitti_root") or "",
        test_list=config.get("test_list") or "",
    shell:
        "dualdepth notebook 01_download_data --out {output.notebook} --set profile={PROFILE:q}"
        " kitti_root={params.kitti_root:q} test_list={params.test_list:q}"


rule prepare_data:
    input:
        f"{WORK}/sources.json",
    output:
        notebook=f"{RESULTS}/notebooks/02_prepare_data.ipynb",
        triplets=f"{WORK}/prepared/triplets.csv",
        identity=f"{WORK}/prepared/identity.json",
        frames=f"{WORK}/prepared/test_frames.json",
        truth=f"{WORK}/prepared/ground_truth.npz",
    params:
        notebook=notebook("02_prepare_data"),
        settings=run_.profile.digest("data"),
        code=code_digest("prepare"),
    shell:
        "dualdepth notebook 02_prepare_data --out {output.notebook} --set profile={PROFILE:q}"


rule train_lr:
    input:
        f"{WORK}/prepared/triplets.csv",
        f"{WORK}/prepared/identity.json",
    output:
        notebook=f"{RESULTS}/notebooks/03_train_lr_seed{{seed}}.ipynb",
        # not the weights themselves: Snakemake deletes the outputs of a failed or stale step
        trained=f"{WORK}/runs/lr/seed{{seed}}/trained.json",
    params:
        notebook=notebook("03_train_lr"),
        settings=run_.settings_digest("lr"),
        code=code_digest("train"),
    threads: ONE_AT_A_TIME
    shell:
        "dualdepth notebook 03_train_lr --out {output.notebook} --set profile={PROFILE:q} seed={wildcards.seed}"


rule table_main:
    input:
        f"{WORK}/prepared/ground_truth.npz",
        expand(f"{WORK}/runs/lr/seed{{seed}}/trained.json", seed=SEEDS),
    output:
        notebook=f"{RESULTS}/notebooks/05_table_main.ipynb",
        table=f"{RESULTS}/tables/main.csv",
        stamp=f"{RESULTS}/tables/main.json",
    params:
        notebook=notebook("05_table_main"),
        settings=run_.profile.digest("evaluation", "about"),
        seeds=",".join(map(str, SEEDS)),
        code=code_digest("evaluate"),
    threads: ONE_AT_A_TIME
    shell:
        "dualdepth notebook 05_table_main --out {output.notebook} --set profile={PROFILE:q} seeds={params.seeds}"
