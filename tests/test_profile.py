"""Profiles: what they say of the paper, and what is said of a bad one."""

import re

import pytest

from dualdepth.errors import InputError
from dualdepth.paper import HR_SIZE, LR_SIZE
from dualdepth.profile import PROFILES, load_profile, standard_variants
from dualdepth.tables.claims import CLAIMS

SHIPPED = sorted(path.stem for path in PROFILES.glob("*.yaml"))

GOOD = """
about: a test
data:
  source: kitti
  train_drives: [2011_09_26/2011_09_26_drive_0001_sync]
"""


@pytest.fixture
def written(tmp_path):
    def write(text, name="own"):
        path = tmp_path / f"{name}.yaml"
        path.write_text(text)
        return str(path)

    return write


@pytest.mark.parametrize("name", SHIPPED)
def test_every_shipped_profile_says_what_it_is_and_has_maps_that_can_be_mirrored(name):
    profile = load_profile(name)
    assert profile.name == name and profile.about
    assert min(profile.data.lr_size) // 32 >= 2


def test_the_paper_profile_is_the_papers_recipe():
    profile = load_profile("paper")
    training = profile.training
    for stage in (training.lr, training.hr):
        assert (stage.epochs, stage.max_steps, stage.batch_size, stage.beta1, stage.beta2) == (40, None, 4, 0.9, 0.999)
        assert stage.learning_rates == [(10, 2e-4), (20, 1e-4), (40, 5e-5)]
    assert (profile.data.hr_size, profile.data.lr_size) == (HR_SIZE, LR_SIZE) == ((384, 1248), (128, 416))
    assert (training.loss.alpha, training.loss.scales, training.encoder, training.pretrained) == (0.85, 4, "resnet50", True)
    assert training.augmentation.augment_first and training.loss.feature > 0
    assert (profile.data.train_list, profile.data.test_list) == ("eigen_zhou", "eigen_test")


def test_a_profile_extends_a_shipped_one_section_by_section_and_trains_what_it_names_itself(tmp_path):
    path = tmp_path / "longer.yaml"
    path.write_text("about: x\nextends: miniature\ntraining: {lr: {epochs: 77}}\ntrain: {lr: }\n")
    longer, base = load_profile(str(path)), load_profile("miniature")
    assert (longer.name, longer.about, longer.training.lr.epochs, [*longer.train]) == ("longer", "x", 77, ["lr"])
    assert longer.training.lr.learning_rates == base.training.lr.learning_rates and longer.world == base.world
    assert longer.verdicts == "none" != base.verdicts
    for wrong in ("longer", "nothing", "../x", "[miniature]"):
        path.write_text(f"about: x\nextends: {wrong}\n")
        with pytest.raises(InputError, match=r"longer\.yaml: extends .* is no shipped profile"):
            load_profile(str(path))


def test_every_claim_of_the_paper_has_its_trainings_in_the_profile_of_claims():
    known = {*load_profile("claims").train}
    for claim in (claim for claim in CLAIMS if claim.of_paper and not claim.a.startswith("gain")):
        assert known >= {*(claim.instead or (claim.a, claim.b))}, claim.text


def test_where_the_poses_of_stage_2_are_scored_posenet_goes_on():
    for name in ("sample_odometry", "paper"):
        assert not load_profile(name).of_variant("odometry_dual").training.hr.beyond_paper_frozen_pose, name


def test_an_unknown_profile_names_those_there_are_and_a_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(InputError, match=r"profile 'papper' not found: choose one of attention, beyond, claims, .*, paper, sample, .*tiny"):
        load_profile("papper")
    with pytest.raises(InputError, match=r"profile .*gone\.yaml. not found"):
        load_profile(str(tmp_path / "gone.yaml"))


def test_paper_trains_every_standard_variant_and_has_nothing_beyond_the_paper():
    profile = load_profile("paper")
    of_the_paper = {name for name, variant in standard_variants().items() if "beyond_paper" not in str(variant.set)}
    assert {*profile.train, "lr_feature_loss"} == of_the_paper  # its LR-Net has that loss
    dual = profile.variant("dual")
    assert (dual.network, dual.link, dual.similarity, dual.normalise, dual.starts_from) == ("dual", "attention", "dot", "none", "lr")
    assert profile.variant("dual_no_sa").link == "direct"
    assert set(re.findall(r"'beyond_paper_\w+': (\w+)", str(profile.training.model_dump()))) == {"False", "0", "None"}


@pytest.mark.parametrize("name", ["trials", "sample_trials"])
def test_additions_are_tried_one_at_a_time_beside_a_stage_1_without_any(name):
    profile = load_profile(name)

    def beyond(variant):
        training = profile.of_variant(variant).training
        values = training.model_dump(exclude={"hr"}) | training.augmentation.model_dump() | training.loss.model_dump()
        return {key: value for key, value in values.items() if key.startswith("beyond_paper") and "residual" not in key and value}

    found = {variant: len(beyond(variant)) for variant in profile.train}
    together = found.pop("lr_together")
    assert found == {"lr": 0} | dict.fromkeys([*found][1:], 1) and together >= 5


def test_a_variant_changes_its_own_settings_only():
    profile = load_profile("paper")
    assert profile.of_variant("lr").training == profile.training
    assert profile.of_variant("lr_no_feature_loss").training.loss.feature == 0
    assert not profile.of_variant("lr_downsample_first").training.augmentation.augment_first
    assert profile.of_variant("dual_scratch").training.pretrained is False
    assert profile.of_variant("mobilenet_v2").training.encoder == "mobilenet_v2"
    changed = profile.of_variant("resnet18").training.model_dump() | {"encoder": "resnet50"}
    assert changed == profile.training.model_dump()


def test_a_profile_sets_a_variants_settings_and_has_variants_of_its_own(written):
    own = """train:
  lr: {training.lr.max_steps: 7}
  mine:
variants:
  mine: {label: Mine, about: x, network: single, set: {training.encoder: mobilenet_v2}}
"""
    profile = load_profile(written(GOOD + own, "other"))
    assert profile.name == "other"
    assert profile.of_variant("lr").training.lr.max_steps == 7
    assert profile.training.lr.max_steps is None
    assert profile.of_variant("mine").training.encoder == "mobilenet_v2"


def mine(network):
    """A variant of the profile's own, with its network and what else is said of it."""
    return f"variants: {{mine: {{label: a, about: x, network: {network}}}}}\n"


BAD_SETTINGS = [
    ("sedes: [1]\n", "unknown setting sedes; did you mean seeds"),
    ("training: {lr: {epoch: 3}}\n", "unknown setting training.lr.epoch; did you mean training.lr.epochs"),
    ("training: {batch_size: 1}\n", "unknown setting training.batch_size; did you mean training.lr.batch_size"),
    ("evaluation: {min_depth: 90}\n", "evaluation.min_depth 90 is not below max_depth 80"),
    ("training: {weight_decay: 1}\n", "unknown setting training.weight_decay; docs/settings.md lists all"),
    ("training: {hr_size: [192, 288]}\n", "unknown setting training.hr_size; did you mean data.hr_size"),
    ("training.lr.epochs: 5\n", "training.lr.epochs: sections are nested; write training: {lr: {epochs: …}}"),
    ("training: {lr.epochs: 5}\n", "training.lr.epochs: sections are nested; write training: {lr: {epochs: …}}"),
    ("  train_drive: x\n", "unknown setting data.train_drive; did you mean data.train_drives"),
    ("1: 2\n", "1"),
    ("training: {precision: float16}\n", "training.precision"),
    ("training: {lr: {learning_rates: []}}\n", "training.lr.learning_rates"),
    ("training: {lr: {learning_rates: [[40, 1.0e-5], [10, 2.0e-4]]}}\n", "in the order of epochs"),
    ("training: {hr: {learning_rates: [[10, -1.0e-5]]}}\n", "rates above 0"),
    ("training: {hr: {beta1: 2}}\n", "training.hr.beta1"),
    ("training: {loss: {mean_disparity: 0}}\n", "training.loss.mean_disparity"),
    ("training: {loss: {smoothness: -1}}\n", "training.loss.smoothness"),
    ("training: {loss: {photometric: .nan}}\n", "training.loss.photometric"),
    ("  hr_size: [380, 1248]\n", "hr_size"),
    ("  hr_size: [96, 288]\n", "hr_size"),
    ("  train_list: eigen_zhou\n", "train_list or train_drives"),
    ("world: {static_frames: 50}\n", "static_frames 50 is more than frames_per_drive 40"),
    ("seeds: [4294967296]\n", "seeds.0"),
    ("training: {workers: 1}\ntraining: {accumulate: 2}\n", "training stands twice"),
    ("world: {test_seed: 1}\n", "the scored streets would be the training streets"),
]
BAD_VARIANTS = [
    ("train: {duall: }\n", "variant 'duall' is unknown; did you mean dual"),
    ("train: {dual: }\n", "dual starts from lr, which is not trained; name it too"),
    ("train: {lr: {training.lr.epoch: 3}}\n", r"variant lr: unknown setting training.lr.epoch; did you mean training.lr.epochs\?"),
    ("train: {lr: {training.lrr.epochs: 3}}\n", r"variant lr: unknown setting training.lrr.epochs; did you mean training.lr.epochs\?"),
    ("train: {lr: {training.lr.epochs: none}}\n", "variant lr: training.lr.epochs"),
    ("train: {lr: {training.loss: {feature: 0}}}\n", "variant lr: training.loss is no single setting of training"),
    ("train: {lr: {data.hr_size: [192, 288]}}\n", "variant lr: data.hr_size is no single setting of training"),
    ("train: {lr: , mine: }\n" + mine("lr, set: {training.lr.foo: 3}"), "variant mine: unknown setting training.lr.foo"),
    ("train: {}\n", "train"),
    ("train: {resnet18: }\n", "train: does not name lr"),
    ("train: {lr: , odometry_lr: , mine: }\n" + mine("dual, starts_from: odometry_lr"), "a leak"),
    (mine("dual"), "network dual needs a variant in `starts_from`"),
    (mine("single, starts_from: lr"), "network single has no variant in `starts_from`"),
    ("variants: {mine: {label: a, about: x}}\n", "variants.mine.network"),
    (mine("lr, simlarity: dot"), "unknown setting variants.mine.simlarity; did you mean variants.mine.similarity"),
    ("train: {lr: , dual: , mine: }\n" + mine("dual, starts_from: dual"), "mine starts from dual, which is no variant of stage 1"),
    ("train: {mine: {training.augmentation.augment_first: false}}\n" + mine("single"), "augment_first must be true at high resolution"),
]
BAD_FILES = [
    (GOOD.replace("  train_drives: [2011_09_26/2011_09_26_drive_0001_sync]\n", ""), "train_list or train_drives"),
    (GOOD.replace("train_drives: [2011_09_26/2011_09_26_drive_0001_sync]", "train_list: a\n  test_scenes: b"), "test_scenes choose from"),
    (GOOD.replace("kitti", "cityscapes"), "data.source"),
    (GOOD.replace("kitti", "miniature"), "world"),
    (GOOD.replace("about: a test\n", ""), "about"),
    ("- a\n- b\n", "expected a mapping of settings, found list"),
    ("", "expected a mapping of settings, found NoneType"),
    ("a: [1,\n", "give settings in YAML"),
]


@pytest.mark.parametrize("name", ["kitti", "published", "lock", "home", "..", "-x", "a b"])
def test_a_profile_cannot_have_the_name_of_a_folder_in_use(written, name):
    with pytest.raises(InputError, match="folders and commands are named by it; name the file with letters"):
        load_profile(written(GOOD, name))


@pytest.mark.parametrize(("text", "said"), [*((GOOD + text, said) for text, said in BAD_SETTINGS + BAD_VARIANTS), *BAD_FILES])
def test_a_bad_profile_is_one_error_that_names_file_setting_and_mend(written, text, said):
    with pytest.raises(InputError, match=rf"own\.yaml: .*{said}"):
        load_profile(written(text))
