# The order of the notebooks: one rule a notebook, a training for each variant and seed. What shapes a step's result stands in its params,
# as digests, so that a changed setting or changed code reruns the step and what depends on it, and nothing else.
from dualdepth.results import Run, code_digest, notebook_digest

PROFILE = config.get("profile", "tiny")
run_ = Run(PROFILE)
NAME = run_.profile.name
SEEDS = [int(s) for s in str(config.get("seeds", "")).split(",") if s] or run_.profile.seeds
WORK, RESULTS = f"work/{NAME}", f"results/{NAME}"
VARIANTS = {stage: [v for v in run_.profile.train if run_.profile.variant(v).stage == stage] for stage in ("lr", "hr")}
TABLES = ["05_table_main", "07_table_ablation", "08_table_distance", "09_table_sharpness", "11_table_backbone", "13_figures"]
# trainings side by side do more in the same time than one after the other on all cores
THREADS = {stage: max(1, workflow.cores // max(1, len(names) * len(SEEDS))) for stage, names in VARIANTS.items()}


def notebook(name):
    """Digest of a notebook's own cells."""
    return notebook_digest(name)


def trained(variants):
    """Markers of trained weights, for all seeds. Not the weights: Snakemake deletes the outputs of a failed or stale step."""
    return expand(f"{WORK}/runs/{{variant}}/seed{{seed}}/trained.json", variant=variants, seed=SEEDS)


def needed(*variants):
    """Those of the variants that the profile trains."""
    return trained([v for v in variants if v in run_.profile.train])


wildcard_constraints:
    lr="|".join(VARIANTS["lr"]) or "none",
    hr="|".join(VARIANTS["hr"]) or "none",
    seed=r"\d+",


rule all:
    input:
        expand(f"{RESULTS}/notebooks/{{page}}.ipynb", page=["00_quickstart", "01_download_data", "02_prepare_data", *TABLES]),
        expand(f"{RESULTS}/notebooks/03_train_lr_{{variant}}_seed{{seed}}.ipynb", variant=VARIANTS["lr"], seed=SEEDS),
        expand(f"{RESULTS}/notebooks/04_train_hr_{{variant}}_seed{{seed}}.ipynb", variant=VARIANTS["hr"], seed=SEEDS),


rule quickstart:
    output:
        f"{RESULTS}/notebooks/00_quickstart.ipynb",
    params:
        notebook=notebook("00_quickstart"),
        code=code_digest("train_lr", "world"),
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
    threads: workflow.cores
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
        notebook=f"{RESULTS}/notebooks/03_train_lr_{{lr}}_seed{{seed}}.ipynb",
        trained=f"{WORK}/runs/{{lr}}/seed{{seed}}/trained.json",
    params:
        notebook=notebook("03_train_lr"),
        settings=lambda wildcards: run_.settings_digest(wildcards.lr),
        code=code_digest("train_lr"),
    threads: THREADS["lr"]
    resources:
        gpu=1,
    shell:
        "OMP_NUM_THREADS={threads} dualdepth notebook 03_train_lr --out {output.notebook}"
        " --set profile={PROFILE:q} variant={wildcards.lr} seed={wildcards.seed}"


rule train_hr:
    input:
        f"{WORK}/prepared/triplets.csv",
        f"{WORK}/prepared/identity.json",
        lambda wildcards: [
            f"{WORK}/runs/{start}/seed{wildcards.seed}/trained.json" for start in [run_.profile.variant(wildcards.hr).starts_from] if start
        ],
    output:
        notebook=f"{RESULTS}/notebooks/04_train_hr_{{hr}}_seed{{seed}}.ipynb",
        trained=f"{WORK}/runs/{{hr}}/seed{{seed}}/trained.json",
    params:
        notebook=notebook("04_train_hr"),
        settings=lambda wildcards: run_.settings_digest(wildcards.hr),
        code=code_digest("train_lr", "train_hr"),
    threads: THREADS["hr"]
    resources:
        gpu=1,
    shell:
        "OMP_NUM_THREADS={threads} dualdepth notebook 04_train_hr --out {output.notebook}"
        " --set profile={PROFILE:q} variant={wildcards.hr} seed={wildcards.seed}"


SHARED = {
    "settings": run_.profile.digest("evaluation", "about"),
    "variants": run_.profile.variants_digest(),
    "seeds": ",".join(map(str, SEEDS)),
    "code": code_digest("predict", "tables"),
}


rule table_main:
    input:
        f"{WORK}/prepared/ground_truth.npz",
        needed("lr", "dual"),
    output:
        notebook=f"{RESULTS}/notebooks/05_table_main.ipynb",
        table=f"{RESULTS}/tables/main.csv",
        stamp=f"{RESULTS}/tables/main.json",
    params:
        **SHARED,
        notebook=notebook("05_table_main"),
    threads: max(1, workflow.cores // 2)
    resources:
        gpu=1,
    shell:
        "OMP_NUM_THREADS={threads} dualdepth notebook 05_table_main --out {output.notebook}"
        " --set profile={PROFILE:q} seeds={params.seeds}"


rule table_ablation:
    input:
        f"{WORK}/prepared/ground_truth.npz",
        needed(*run_.profile.train),
    output:
        notebook=f"{RESULTS}/notebooks/07_table_ablation.ipynb",
        table=f"{RESULTS}/tables/ablation.csv",
        stamp=f"{RESULTS}/tables/ablation.json",
    params:
        **SHARED,
        notebook=notebook("07_table_ablation"),
    threads: max(1, workflow.cores // 2)
    resources:
        gpu=1,
    shell:
        "OMP_NUM_THREADS={threads} dualdepth notebook 07_table_ablation --out {output.notebook}"
        " --set profile={PROFILE:q} seeds={params.seeds}"


rule table_distance:
    input:
        f"{WORK}/prepared/ground_truth.npz",
        needed("lr", "dual_no_sa", "dual"),
    output:
        notebook=f"{RESULTS}/notebooks/08_table_distance.ipynb",
        table=f"{RESULTS}/tables/distance.csv",
        stamp=f"{RESULTS}/tables/distance.json",
    params:
        **SHARED,
        notebook=notebook("08_table_distance"),
    threads: max(1, workflow.cores // 2)
    resources:
        gpu=1,
    shell:
        "OMP_NUM_THREADS={threads} dualdepth notebook 08_table_distance --out {output.notebook}"
        " --set profile={PROFILE:q} seeds={params.seeds}"


rule table_sharpness:
    input:
        f"{WORK}/prepared/ground_truth.npz",
        needed("lr", "dual_no_sa", "dual"),
    output:
        notebook=f"{RESULTS}/notebooks/09_table_sharpness.ipynb",
        table=f"{RESULTS}/tables/sharpness.csv",
        stamp=f"{RESULTS}/tables/sharpness.json",
    params:
        **SHARED,
        notebook=notebook("09_table_sharpness"),
    threads: max(1, workflow.cores // 2)
    resources:
        gpu=1,
    shell:
        "OMP_NUM_THREADS={threads} dualdepth notebook 09_table_sharpness --out {output.notebook}"
        " --set profile={PROFILE:q} seeds={params.seeds}"


rule table_backbone:
    input:
        f"{WORK}/prepared/ground_truth.npz",
        needed("lr", "dual", "mobilenet_v2", "resnet18", "dual_scratch"),
    output:
        notebook=f"{RESULTS}/notebooks/11_table_backbone.ipynb",
        table=f"{RESULTS}/tables/backbone.csv",
        stamp=f"{RESULTS}/tables/backbone.json",
    params:
        **SHARED,
        notebook=notebook("11_table_backbone"),
    threads: workflow.cores  # it measures time
    resources:
        gpu=1,
    shell:
        "dualdepth notebook 11_table_backbone --out {output.notebook}"
        " --set profile={PROFILE:q} seeds={params.seeds}"


rule figures:
    input:
        f"{WORK}/prepared/ground_truth.npz",
        needed("lr", "dual"),
    output:
        notebook=f"{RESULTS}/notebooks/13_figures.ipynb",
    params:
        **SHARED,
        notebook=notebook("13_figures"),
    threads: max(1, workflow.cores // 2)
    resources:
        gpu=1,
    shell:
        "OMP_NUM_THREADS={threads} dualdepth notebook 13_figures --out {output.notebook}"
        " --set profile={PROFILE:q} seeds={params.seeds}"
