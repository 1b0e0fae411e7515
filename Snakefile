# The order of the notebooks: one rule a notebook, one a training. What shapes a step's result, beside its input files, stands in its
# params by name, so that a changed setting or changed code reruns the step and what depends on it, and nothing else.
from pathlib import Path

from dualdepth.files import file_digest, folder_digest
from dualdepth.run import PACKAGE, RECORD, ROOTS, Run

asked = config.get("given", config)  # by `dualdepth reproduce`, or `snakemake --config profile=tiny`
PROFILE = asked.get("profile", "miniature")
run_ = Run(PROFILE)
NAME = run_.profile.name
SEEDS = [int(s) for s in str(asked.get("seeds", "")).split(",") if s] or run_.profile.seeds
WORK, RESULTS = f"work/{NAME}", f"results/{NAME}"
GIVEN = {name: asked.get(name) or "" for name in ROOTS} | {"allow_leak": int(asked.get("allow_leak") or 0)}
# without odometry's frames there is nothing to train its variants on; their table says so
DEPTH, ODOMETRY = run_.profile.trained_on("depth"), run_.profile.trained_on("odometry")
TRAINED = DEPTH + (ODOMETRY if run_.profile.world or GIVEN["odometry_root"] else [])
NOTEBOOKS = {"lr": "03_train_lr", "hr": "04_train_hr"}
STAGE = {variant: run_.profile.variant(variant).stage for variant in TRAINED}
# each page that scores trainings: its table, if it has one, and the trainings
PAGES = {
    "05_table_main": ("main", ["lr", "dual"]),
    "06_table_make3d": ("make3d", ["lr", "dual_no_sa", "dual"]),
    "07_table_ablation": ("ablation", DEPTH),
    "08_table_distance": ("distance", ["lr", "dual_no_sa", "dual"]),
    "09_table_sharpness": ("sharpness", ["lr", "dual_no_sa", "dual"]),
    "10_table_sa_region": ("sa_region", ["dual_no_sa", "dual"]),
    "11_table_backbone": ("backbone", ["lr", "dual", "mobilenet_v2", "resnet18", "dual_scratch"]),
    "12_table_odometry": ("odometry", list(run_.profile.pose_variants)),
    "13_figures": (None, ["lr", "dual"]),
}
# a data set of an own camera may be made anew in the same folder
LISTED = {"test_list": file_digest(Path(GIVEN["test_list"]))} if GIVEN["test_list"] else {}
OWN = {} if run_.profile.data.has_truth else {RECORD: file_digest(Path(GIVEN["kitti_root"]) / RECORD)}


DRAWING = {"overview.svg": file_digest(run_.root / "docs/overview.svg")}


def trained(variants):
    """Markers of trained weights, for all seeds. Not the weights: Snakemake deletes the outputs of a failed or stale step."""
    return expand(f"{WORK}/runs/{{variant}}/seed{{seed}}/trained.json", variant=variants, seed=SEEDS)


def needed(*variants):
    """Those of the variants that the profile trains."""
    return trained([v for v in variants if v in TRAINED])


wildcard_constraints:
    seed=r"\d+",


# compute nodes of a cluster may have no network
localrules: download_data


rule all:
    input:
        expand(f"{RESULTS}/notebooks/{{page}}.ipynb", page=["00_quickstart", "01_download_data", "02_prepare_data", *PAGES, "14_report"]),
        expand(f"{RESULTS}/tables/{{table}}.{{end}}", table=[table for table, _ in PAGES.values() if table], end=["csv", "json"]),
        f"{RESULTS}/report.html",
        f"{WORK}/prepared/test_frames.json",
        [f"{RESULTS}/notebooks/{NOTEBOOKS[STAGE[v]]}_{v}_seed{seed}.ipynb" for v in TRAINED for seed in SEEDS],


rule quickstart:
    input:
        [f"{WORK}/runs/{v}/seed{SEEDS[0]}/trained.json" for v in ("lr", "dual") if v in TRAINED],
    output:
        f"{RESULTS}/notebooks/00_quickstart.ipynb",
    params:
        *run_.made_from("00_quickstart", "quickstart", files=DRAWING),
        seed=SEEDS[0],
    shell:
        "dualdepth notebook 00_quickstart --out {output} --set profile={PROFILE:q} seed={params.seed}"


rule download_data:
    output:
        notebook=f"{RESULTS}/notebooks/01_download_data.ipynb",
        sources=f"{WORK}/sources.json",
    params:
        *run_.made_from("01_download_data", "data", setting=run_.profile.values("world", "data"), given=GIVEN, files=OWN | LISTED),
    threads: workflow.cores
    shell:
        "dualdepth notebook 01_download_data --out {output.notebook} --set profile={PROFILE:q}"
        " kitti_root={GIVEN[kitti_root]:q} test_list={GIVEN[test_list]:q} odometry_root={GIVEN[odometry_root]:q}"
        " make3d_root={GIVEN[make3d_root]:q} labels_root={GIVEN[labels_root]:q} allow_leak={GIVEN[allow_leak]}"


rule prepare_data:
    input:
        f"{WORK}/sources.json",
    output:
        notebook=f"{RESULTS}/notebooks/02_prepare_data.ipynb",
        triplets=f"{WORK}/prepared/triplets.csv",
        identity=f"{WORK}/prepared/identity.json",
        frames=f"{WORK}/prepared/test_frames.json",
        truth=f"{WORK}/prepared/ground_truth.npz",
        odometry=[f"{WORK}/prepared/odometry.csv"] if set(ODOMETRY) <= set(TRAINED) and ODOMETRY else [],
    params:
        *run_.made_from("02_prepare_data", "data", setting=run_.profile.values("data") | {"odometry": ODOMETRY != []}),
    shell:
        "dualdepth notebook 02_prepare_data --out {output.notebook} --set profile={PROFILE:q}"


for variant in TRAINED:

    rule:
        name:
            f"train_{variant}"
        input:
            str(run_.index(variant).relative_to(run_.root)),
            f"{WORK}/prepared/identity.json",
            [f"{WORK}/runs/{start}/seed{{seed}}/trained.json" for start in [run_.profile.variant(variant).starts_from] if start],
        output:
            notebook=f"{RESULTS}/notebooks/{NOTEBOOKS[STAGE[variant]]}_{variant}_seed{{seed}}.ipynb",
            trained=f"{WORK}/runs/{variant}/seed{{seed}}/trained.json",
        params:
            *run_.made_from(NOTEBOOKS[STAGE[variant]], "training_page", setting=run_.settings(variant)),
            page=NOTEBOOKS[STAGE[variant]],
            variant=variant,
        # trainings side by side do more in the same time than one after the other on all cores
        threads: max(1, workflow.cores // max(1, len(SEEDS) * sum(stage == STAGE[variant] for stage in STAGE.values())))
        resources:
            gpu=1,
        shell:
            "OMP_NUM_THREADS={threads} dualdepth notebook {params.page} --out {output.notebook}"
            " --set profile={PROFILE:q} variant={params.variant} seed={wildcards.seed}"


SHARED = {
    "setting": run_.profile.values("evaluation", "about"),
    "variant": run_.profile.trained_variants(),
    "given": {"seeds": ",".join(map(str, SEEDS))},
}

# what a user may replace in a folder of their own
FILES = {
    "make3d": {"make3d_root": folder_digest(GIVEN["make3d_root"], "*/*.jpg", "*/*.mat", "*/*/*.mat")},
    "odometry": {"odometry_root": folder_digest(GIVEN["odometry_root"], "poses/*.txt", "sequences/*/poses.txt")},
    "sa_region": {"labels_root": folder_digest(GIVEN["labels_root"], "*/*.png", "labels.json")},
}

for page, (table, names) in PAGES.items():

    rule:
        name:
            page
        input:
            f"{WORK}/prepared/ground_truth.npz",
            needed(*names),
        output:
            notebook=f"{RESULTS}/notebooks/{page}.ipynb",
            table=[f"{RESULTS}/tables/{table}.csv", f"{RESULTS}/tables/{table}.json"] if table else [],
        params:
            *run_.made_from(page, "tables", files=FILES.get(table, FILES["sa_region"] | DRAWING), **SHARED),
            page=page,
            seeds=",".join(map(str, SEEDS)),
        threads: workflow.cores if table == "backbone" else max(1, workflow.cores // 2)  # the one measures time
        resources:
            gpu=1,
        shell:
            "OMP_NUM_THREADS={threads} dualdepth notebook {params.page} --out {output.notebook}"
            " --set profile={PROFILE:q} seeds={params.seeds}"


rule report:
    input:
        expand(f"{RESULTS}/notebooks/{{page}}.ipynb", page=PAGES),
    output:
        notebook=f"{RESULTS}/notebooks/14_report.ipynb",
        page=f"{RESULTS}/report.html",
    params:
        *run_.made_from(
            "14_report",
            "report",
            **SHARED | {"setting": SHARED["setting"] | run_.profile.values("verdicts", "training.loss")},
            files={name: file_digest(PACKAGE / name) for name in ("report.html.j2", "report.yaml", "assumptions.yaml")} | DRAWING,
        ),
    shell:
        "dualdepth notebook 14_report --out {output.notebook} --set profile={PROFILE:q}"


onsuccess:
    from dualdepth.report import first_look

    print(first_look(run_))


onerror:
    print("error: the chain stopped, see above; the same command goes on there", file=sys.stderr)
