"""The sections of a profile: every setting with its reason. What a profile's YAML does not say stands here, and nowhere else."""

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from dualdepth.networks import Network, PoseEncoder
from dualdepth.networks.architecture import Design, HRSize

Size = Annotated[tuple[int, int], Field(description="(height, width) in pixels")]


class Settings(BaseModel):
    """Base of all sections: unknown keys are refused, values are fixed once read."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class World(Settings):
    """The embedded synthetic street world (`data_scripts/make_miniature.py`)."""

    train_seed: int = Field(1, ge=0)
    """Seed of the training streets."""
    test_seed: int = Field(1001, ge=0)
    """Seed of the streets that are scored; never used to choose anything in `miniature`."""
    size: Size = (208, 656)
    """Size of the raw and odometry frames; KITTI's shape at about half its width."""
    supersample: int = Field(3, ge=1)
    """Rays per pixel side: the anti-aliasing that lets a full-resolution image hold more than its small copy."""
    train_drives: int = Field(3, ge=1)
    """Training drives, each in a street of its own."""
    frames_per_drive: int = Field(40, ge=3)
    """Frames of a training drive, consecutive."""
    static_frames: int = Field(6, ge=0)
    """Length of the stretch in the first training drive where the camera stands still."""
    laser_train_frames: int = Field(5, ge=0)
    """Frames with a laser scan in each training drive, evenly spread; baselines are fitted on them."""
    azimuth_step: float = Field(0.35, gt=0)
    """Degrees between the laser's firings; KITTI's 0.17 at half the width."""
    test_drives: int = Field(2, ge=1)
    """Scored drives, each in a street of its own."""
    test_frames: int = Field(8, ge=1)
    """Scored frames a test drive; only they are rendered."""
    odometry_train: int = Field(1, ge=0, le=9)
    """Training sequences 00, 01, ..."""
    odometry_test: int = Field(2, ge=0, le=2)
    """Test sequences 09 and 10."""
    odometry_frames: int = Field(30, ge=3)
    """Frames a training sequence."""
    odometry_path: float = Field(250.0, ge=10)
    """Metres that the path of a test sequence is longer than; trajectories are scored on segments from 100 m on."""
    odometry_spacing: float = Field(2.5, gt=0)
    """Mean metres between odometry frames: a fast car, so that 250 m need few frames."""
    make3d_images: int = Field(3, ge=0)
    """Upright photos with a laser grid."""
    make3d_size: Size = (568, 426)
    """Size of the photos, a quarter of Make3D's 2272x1704."""

    @model_validator(mode="after")
    def _consistent(self) -> "World":
        if self.train_seed == self.test_seed:
            raise ValueError(f"train_seed and test_seed are both {self.train_seed}: the scored streets would be the training streets")
        if self.static_frames > self.frames_per_drive:
            raise ValueError(f"static_frames {self.static_frames} is more than frames_per_drive {self.frames_per_drive}")
        return self


class Data(Settings):
    """Which frames are trained on and which are scored."""

    source: Literal["miniature", "kitti", "own"]
    """`own`: a data set of data_scripts/own_camera.py, which names its drives itself and has no ground truth."""
    train_list: str | None = None
    """Name of a field's list with its training triplets (`eigen_zhou`), used unchanged; else `train_drives`."""
    train_drives: list[str] = []
    """Drives like `2011_09_26/2011_09_26_drive_0095_sync`, with `:image_00` for one camera; neighbours in number make a triplet."""
    cameras: list[str] = ["image_02"]
    """Camera folders a drive is read from; the first that exists is used by `train_drives`."""
    static_frames: str | None = None
    """Name of a list of frames where the camera stands still; they are left out of `train_drives`."""
    test_scenes: str | None = None
    """Name of a list of drives that must not be trained on."""
    baseline_frames: int = Field(400, ge=0)
    """Training-side laser frames, at most, that the baselines without learning are fitted on."""
    test_list: str | None = None
    """Name of a list (`eigen_test`) or path of a file with the frames to score."""
    allow_missing: bool = False
    """Score what is there of an incomplete test list, and say "25 of 697" in the table."""
    odometry_train: list[str] = [f"{number:02d}" for number in range(9)]
    """Odometry sequences to train on, with `:image_0` for another camera than image_2; the paper's. The synthetic world has its own. Where
    there are none, the PoseNets of the depth tables are scored."""
    odometry_test: list[str] = ["09", "10"]
    """Odometry sequences to score; the paper's. The synthetic world has its own."""
    hr_size: HRSize = (384, 1248)
    """Input of HR-Net; LR-Net sees exactly a third of it (paper, section "Dual Network Architecture")."""

    @model_validator(mode="after")
    def _lists(self) -> "Data":
        if self.source == "kitti" and bool(self.train_list) == bool(self.train_drives):
            raise ValueError("give either train_list or train_drives")
        if self.train_list and (self.static_frames or self.test_scenes):
            raise ValueError("static_frames and test_scenes choose from train_drives; a train_list is used unchanged")
        if self.source == "own" and (self.train_list or self.train_drives or self.test_list):
            raise ValueError("train_list, train_drives and test_list are not for source: own, whose data set names its frames itself")
        return self

    @property
    def has_truth(self) -> bool:
        """Whether the frames of the test list have ground truth; without it they are shown, not scored."""
        return self.source != "own"

    @property
    def lr_size(self) -> tuple[int, int]:
        """Input of LR-Net, (height, width)."""
        return self.hr_size[0] // 3, self.hr_size[1] // 3


class Augmentation(Settings):
    """Random scale and crop (SfMLearner, GeoNet); the paper names no flip and no colour change."""

    max_scale: float = Field(1.15, ge=1.0)
    """Independent enlargement of x and y, uniform in [1, max_scale] (SfMLearner, GeoNet)."""
    augment_first: bool = True
    """Scale and crop at full resolution, then down-sample (paper, "Implementation Details")."""
    beyond_paper_flip: bool = False
    """Beyond the paper: mirror half of the samples."""
    beyond_paper_colour: float = Field(0.0, ge=0.0, lt=1.0)
    """Beyond the paper: brightness, contrast and saturation of what the networks see change by up to this share, the same for all frames of
    a triplet; the losses compare the frames as they are (monodepth2 has 0.2)."""


class Loss(Settings):
    """Weights of the paper's total loss; it gives none of them.

    Ours lie between the lineage's ends (GeoNet and monodepth2). λ2 was the best for LR-Net, by Abs Rel and δ<1.25, of 0.01, 0.03 and 0.1
    on synthetic streets that were scored in no run; the others are the first that learned in a short trial on KITTI's drive 0095.
    """

    photometric: float = Field(1.0, ge=0.0)
    """λ1."""
    smoothness: float = Field(0.03, ge=0.0)
    """λ2, halved at each coarser scale; acts on mean-normalised inverse depth. GeoNet has 0.5, monodepth2 0.001."""
    feature: float = Field(0.01, ge=0.0)
    """λ3; small, since learned features can shrink to please it; 0 switches the loss off (the paper argues for it)."""
    alpha: float = Field(0.85, ge=0.0, le=1.0)
    """Share of SSIM in the photometric loss (paper)."""
    mean_disparity: float = Field(1.0, gt=0.0)
    """Spatial mean to which each image's disparity is scaled, as DDVO writes it; its code has 10, where a unit of translation moves pixels
    ten times as far as a unit of rotation, and rotation is learned last."""
    scales: int = Field(4, ge=1, le=4)
    """Resolutions 1/1, 1/2, 1/4, 1/8 (paper)."""
    beyond_paper_automask: bool = False
    """Beyond the paper: drop pixels that the unwarped source explains better (monodepth2)."""
    beyond_paper_full_resolution: bool = False
    """Beyond the paper: disparities of all scales are enlarged and compare images at full size, not at their own (monodepth2)."""


class StageSettings(Settings):
    """One training stage."""

    epochs: int = Field(40, ge=1)
    """40 + 40 in the paper."""
    batch_size: int = Field(4, ge=1)
    """4 in the paper, both stages."""
    learning_rates: list[tuple[int, float]] = Field([(10, 2e-4), (20, 1e-4), (40, 5e-5)], min_length=1)
    """(last epoch, rate): the paper's steps. In shorter runs the epochs are stretched in proportion."""
    beta1: float = Field(0.9, ge=0.0, lt=1.0)
    beta2: float = Field(0.999, ge=0.0, lt=1.0)
    max_steps: int | None = Field(None, ge=1)
    """Ends the stage early; None trains all epochs."""

    @model_validator(mode="after")
    def _rates(self) -> "StageSettings":
        epochs, rates = zip(*self.learning_rates)
        if list(epochs) != sorted({*epochs}) or epochs[0] < 1 or min(rates) <= 0:
            raise ValueError(f"learning_rates {self.learning_rates}: give (last epoch, rate) in the order of epochs, rates above 0")
        return self


class SecondStage(StageSettings):
    """Stage 2, and what of it goes beyond the paper."""

    beyond_paper_frozen_pose: bool = False
    """Beyond the paper: PoseNet stays as stage 1 left it, which saves a part of each step (docs/learning.md, "Real KITTI")."""


class Training(Settings):
    """Both stages and how they run."""

    encoder: str = "resnet50"
    """LR-Net's encoder: resnet50, resnet18, mobilenet_v2, efficientnet_lite0, or a hierarchical AutoBackbone's name or folder."""
    pretrained: bool | str = True
    """ImageNet weights (paper) from the hub, its cache, or a package (efficientnet_lite0); or from a folder. False needs no network."""
    lr: StageSettings = StageSettings()
    """Stage 1: LR-Net and PoseNet."""
    hr: SecondStage = SecondStage()
    """Stage 2: HR-Net and SA-Attention beside a frozen LR-Net; PoseNet begins as stage 1 left it."""
    augmentation: Augmentation = Augmentation()
    loss: Loss = Loss()
    beyond_paper_residual: bool = False
    """Beyond the paper: in stage 2 HR-Net adds to LR-Net's logits and so begins with its depth; in the paper it begins from nothing."""
    beyond_paper_residual_floor: float = Field(-7.0, lt=0)
    """Lowest logit of LR-Net that is added to, four times as far as the mean; at −8, six times. Far below, the sigmoid gives no gradient
    to bring nearer what LR-Net took for infinitely far (docs/learning.md, "Stage 2")."""
    beyond_paper_residual_anchor: float = Field(0.0, ge=0.0, allow_inf_nan=False)
    """Weight of the mean size of what HR-Net adds to LR-Net's logits where the image is flat (`losses.anchor`). There no depth explains
    images better than another, and without it the depth of asphalt gets worse the longer stage 2 lasts."""
    beyond_paper_corridor_steps: int = Field(0, ge=0)
    """Beyond the paper: in so many first steps a new PoseNet learns alone, from frames that it takes for a level road between
    walls (`stages.corridor`), the paper's PoseNet at a rate of 1e-3. Depth then begins with motions that turn; else it
    imitates what the camera's turns should explain."""
    beyond_paper_refined_after: int | None = Field(None, ge=0)
    """Beyond the paper: after so many steps PoseNet's poses are refined by direct image alignment before images are compared
    (`refinement.py`), and PoseNet learns from the difference; None never does. Before depth has a shape, alignment finds wrong poses; a
    dual network has LR-Net's depth for it, from stage 2's first step."""
    beyond_paper_pose_encoder: PoseEncoder | None = None
    """Beyond the paper: PoseNet is such an encoder, begun like LR-Net's, with a small head behind it, as in monodepth2; depth then learns
    sooner."""
    beyond_paper_average: float = Field(0.0, ge=0.0, lt=1.0)
    """Beyond the paper: the weights that are kept are the running mean of those after each step (Polyak), with this decay, at first a
    shorter one; 0 keeps those of the last step. Short trainings at high rates go up and down from step to step, their mean does not."""
    precision: Literal["auto", "float32", "bf16"] = "auto"
    """Of the networks; geometry and losses are always float32. `auto`: bf16 where the device computes in it, else float32;
    a training ends in the precision in which it began, and its card says which that was."""
    channels_last: bool = True
    compile: bool = False
    """Whether `torch.compile` makes one program of a step, which takes minutes; where a forward pass cannot be compiled, a line says so
    and training goes on without. On CPUs a short training does not get these minutes back (docs/speed.md); not measured on GPUs."""
    deterministic: bool = True
    """Whether torch takes algorithms that give the same bits each time; on a GPU others may be faster (`make bench-gpu`)."""
    workers: int = Field(2, ge=0)
    """Loader processes."""
    accumulate: int = Field(1, ge=1)
    """Parts that a batch is cut into, for GPUs that cannot hold it whole; batch norm then sees the parts."""
    checkpoint_every: int = Field(200, ge=1)
    """Steps between resumable checkpoints."""
    checkpoint_minutes: float = Field(10.0, gt=0)
    """Minutes after which one is due, however few the steps."""
    keep_checkpoints: int = Field(2, ge=1)
    """How many are kept: if the newest is damaged, the one before is used."""
    log_every: int = Field(20, ge=1)
    """Steps between rows of the log."""
    panel_every: int = Field(500, ge=1)
    """Steps between image panels (target, warped, depth, error)."""


class Evaluation(Settings):
    """The protocol of the main table; the field's standard is the default (docs/protocols.md, "Depth on the Eigen split")."""

    resize: Literal["depth", "disparity"] = "depth"
    """What is resized to the ground truth's size; SfMLearner and GeoNet resize depth."""
    crop: Literal["garg", "eigen", "none"] = "garg"
    min_depth: float = Field(1e-3, gt=0)
    max_depth: float = Field(80.0, gt=0, allow_inf_nan=False)

    @model_validator(mode="after")
    def _range(self) -> "Evaluation":
        if not self.min_depth < self.max_depth:
            raise ValueError(f"evaluation.min_depth {self.min_depth:g} is not below max_depth {self.max_depth:g}")
        return self


class Variant(Design, Settings):
    """One training: which network learns (the words of `Design`), from what, what it changes in the profile (`dualdepth/variants.yaml`)."""

    network: Network
    label: str
    """Its name in tables."""
    about: str
    """One sentence for cards and notes."""
    trains_on: Literal["depth", "odometry"] = "depth"
    """Drives of the depth tables, or sequences of the odometry table; two trainings, since each one's test drives are the other's data."""
    starts_from: str | None = None
    """The variant of stage 1 whose LR-Net is frozen inside and whose PoseNet is taken over; of `hr` only PoseNet."""
    set: dict[str, Any] = Field({})
    """Settings of the profile that differ, by dotted name: `training.loss.feature: 0`."""

    @model_validator(mode="after")
    def _start(self) -> "Variant":
        if (self.starts_from is not None) != (self.network in ("dual", "hr")):
            raise ValueError(f"network {self.network} {'has no' if self.starts_from else 'needs a'} variant in `starts_from`")
        return self

    @property
    def stage(self) -> Literal["lr", "hr"]:
        """Section of `training` with its epochs, batch and rates."""
        return "lr" if self.network == "lr" else "hr"
