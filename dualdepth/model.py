"""A trained network and its card: `load(weights).predict(image)`, disparities for the tables, motions of PoseNet."""

import inspect
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from huggingface_hub import ModelCard, ModelHubMixin, snapshot_download
from pydantic import ValidationError
from torch import Tensor, nn
from tqdm import tqdm

from dualdepth.data.frames import resample
from dualdepth.data.kitti import read_image
from dualdepth.device import Precision, choose_device, inference_precision
from dualdepth.errors import InputError
from dualdepth.evaluation.depth import resize_bilinear
from dualdepth.geometry import low_resolution, pose_matrix, resize_intrinsics, to_unit
from dualdepth.networks import PoseEncoder
from dualdepth.networks.architecture import Architecture, HRSize
from dualdepth.networks.pose_net import EncoderPoseNet, PoseNet, make_pose_net
from dualdepth.refinement import LARGE, refined
from dualdepth.training.weights import HUB_CARD, load_card, load_weights, save_weights

WEIGHTS = "model.safetensors"
RELEASED = Path(__file__).parent / "released"  # The weights that come with the package (`python -m tools.publish weights`).
Image = str | Path | np.ndarray
"""An image file (turned as its EXIF data say; grey, 16-bit and transparent ones are read as 8-bit RGB), or (H, W, 3) uint8 RGB."""


class _Card(Architecture):
    """The words of a card that say which networks its weights are of, and (height, width) of their images."""

    hr_size: HRSize
    pose_encoder: PoseEncoder | None = None


class DepthModel(nn.Module, ModelHubMixin):
    """A depth network with its card: images in, relative depth out. `dualdepth.load` makes one of what `save_pretrained` writes.

    Args:
        card: names the network (`network`, `encoder`, `link`, `similarity`, `normalise`, as far as they are not the defaults of
            `networks.architecture.Architecture`) and `hr_size`, [height, width] in pixels of the images that it sees.
        net: the network that the card names; None makes one with random weights.
        device: such as `cpu`, `cuda`, `cuda:1`, `mps`; None takes a GPU where there is one.
        precision: `float32` or `bf16`; None takes bf16 on a CUDA GPU that has it, else float32, in which the tables are scored.

    Raises:
        InputError: the card names no network of this project, or the device or precision is not to be had.

    >>> import numpy as np, dualdepth
    >>> model = dualdepth.DepthModel({"network": "hr", "hr_size": [192, 288]}, device="cpu")  # untrained
    >>> model.about
    'Depth is relative: its unit is unknown. The card does not say what these weights were learned from.'
    >>> image = np.zeros((60, 200, 3), np.uint8)
    >>> depth = model.predict(image)
    >>> depth.shape, depth.dtype.name, bool((depth > 0).all())
    ((60, 200), 'float32', True)
    """

    def __init__(
        self,
        card: dict[str, Any],
        net: nn.Module | None = None,
        *,
        device: str | torch.device | None = None,
        precision: Precision | None = None,
    ) -> None:
        super().__init__()
        self.architecture = _of_card(card, "the card")
        self.size = self.architecture.hr_size
        """(height, width) that images are resized to; LR-Net sees a third of it."""
        self.card = card | self.architecture.model_dump(mode="json")
        """What is known of the weights."""
        self.device = choose_device(device)
        self.precision = inference_precision(precision, self.device)
        layout = torch.channels_last if self.device.type == "cuda" else torch.preserve_format
        self.depth_net = (net or self.architecture.build()).to(self.device, memory_format=layout)
        self.eval()

    @property
    def about(self) -> str:
        """That depth is relative, what it was learned from, what not to expect of it, and its licence, in one line."""
        card = self.card
        learned = f"Learned by {card['about']}." if card.get("about") else "The card does not say what these weights were learned from."
        started = "The encoder began with ImageNet weights." if card.get("pretrained") else ""
        licence = f"Licence of the weights: {card['licence']}." if card.get("licence") else ""
        return " ".join(filter(None, ["Depth is relative: its unit is unknown.", learned, started, card.get("limits"), licence]))

    def __repr__(self) -> str:
        return f"DepthModel({self.architecture.network}, {self.size[1]}×{self.size[0]}, {self.device}, {self.precision}): {self.about}"

    def forward(self, image: Tensor) -> Tensor:
        """Finest disparity (B, 1, h, w) of images (B, 3, H, W) in [0, 1] of size `size`; LR-Net sees them averaged 3×3, so h = H/3."""
        seen = low_resolution(image) if self.architecture.sees_low_resolution else image
        return self.depth_net(seen, scales=1).disparities[0]

    def predict(self, image: Image) -> np.ndarray:
        """Depth (H, W) float32 of one image of any size, at that size: 1 / the network's disparity, 0.1 to 100 in an unknown unit.

        `image` is a file or (H, W, 3) uint8 RGB, see `Image`; it is resized to the network's size. An `InputError` says that the file is
        missing, broken or no image, or that the array is of another shape or type.
        """
        return self.predict_batch([image])[0]

    def predict_batch(self, images: Sequence[Image]) -> list[np.ndarray]:
        """Depths of some images, of any sizes, computed together; see `predict`."""
        arrays = [_rgb(image, read_image) for image in images]
        depths = np.float32(1) / self.disparities(arrays, batch_size=max(1, len(arrays)))
        return [resize_bilinear(depth, array.shape[:2]) for depth, array in zip(depths, arrays)]

    @torch.inference_mode()
    def disparities(
        self, images: Sequence[Image], *, batch_size: int = 4, read: Callable[[str | Path], np.ndarray] = read_image
    ) -> np.ndarray:
        """Disparities (N, h, w) float32, positive, of unknown scale, of images as of `predict`, with a progress bar; what the tables score.

        They have the network's own size. `batch_size` images are computed together; `read` gives (H, W, 3) uint8 RGB of a file. An
        `InputError` says that an image cannot be read or a number is not finite.
        """
        maps, _ = [], self.eval()  # whatever mode the caller left it in
        with tqdm(total=len(images), desc="predicting", unit="image", disable=len(images) <= batch_size) as bar:
            for start in range(0, len(images), batch_size):
                batch = [tensor_of(_rgb(image, read), self.size) for image in images[start : start + batch_size]]
                seen = to_unit(torch.stack(batch).to(self.device))
                with torch.autocast(self.device.type, torch.bfloat16, enabled=self.precision == "bf16"):
                    maps.append(self(seen)[:, 0].float().cpu().numpy())
                bar.update(len(batch))
        disparities = np.concatenate(maps or [np.empty((0, *self.size), np.float32)])
        if not np.isfinite(disparities).all():
            raise InputError(f"the network's numbers are not finite in {self.precision}; its weights are damaged or need float32")
        return disparities

    @classmethod
    def from_pretrained(
        cls, weights: str | Path = RELEASED, device: str | torch.device | None = None, precision: Precision | None = None, **hub: Any
    ) -> "DepthModel":
        """Load trained weights; those that come with the package are named on stderr.

        Args:
            weights: a `.safetensors` file with its card beside it (`<name>.json` or `config.json`), the folder of one, or `owner/name` on
                the model hub; left out, those that come with the package.
            device, precision: as of the class.
            hub: options of `huggingface_hub.snapshot_download`, such as `revision`, `cache_dir`, `token`, `local_files_only`.

        An `InputError` says that the weights or their card are missing, damaged, changed (sha256) or of another network, or what the class
        says.

        >>> import numpy as np, dualdepth
        >>> dualdepth.load().predict(np.zeros((375, 1242, 3), np.uint8)).shape
        (375, 1242)
        """
        inspect.signature(snapshot_download).bind(weights, **hub)  # unknown options are a TypeError of folders, too
        path = Path(weights)
        if not path.exists():
            if path.is_absolute() or path.suffix == ".safetensors" or str(weights).count("/") != 1:
                raise InputError(f"{weights}: no such weights; give {WEIGHTS} of a training, its folder, or owner/name on the model hub")
            try:
                path = Path(snapshot_download(str(weights), allow_patterns=[HUB_CARD, WEIGHTS], **hub))
            except (OSError, ValueError) as error:  # no network, no such name
                reason = next(iter(str(error).splitlines()), type(error).__name__)
                raise InputError(f"{weights}: no folder, and not to be had from the model hub ({reason}); check the name") from None
        path = path / WEIGHTS if path.is_dir() else path
        card = load_card(path)
        _of_card(card, path.with_suffix(".json"), *Architecture.model_fields)  # a card in a file names all, and no default is taken
        model = cls(card, device=device, precision=precision)
        load_weights(path, model.depth_net, prefix="depth_net.")
        if path.parent == RELEASED:
            print(f"the package's own weights: {model.about}", file=sys.stderr)
        return model

    def _save_pretrained(self, save_directory: Path) -> None:
        card = {key: value for key, value in self.card.items() if key != "sha256"}
        save_weights(save_directory / WEIGHTS, self, card, HUB_CARD)

    def generate_model_card(self, *_args: Any, **_kwargs: Any) -> ModelCard:
        """The page that the model hub shows."""
        title = f"dualdepth: {self.card.get('variant', self.architecture.network)}"
        template = Path(__file__).with_name("model_card.txt").read_text(encoding="utf-8")
        return ModelCard(template.format(title=title, about=self.about, card=HUB_CARD))


load = DepthModel.from_pretrained


def load_pose_net(weights: str | Path, device: str | torch.device = "cpu") -> tuple[PoseNet | EncoderPoseNet, tuple[int, int]]:
    """The PoseNet of a training, in eval mode, and (height, width) that frames are resized to; it sees a third of it.
    An `InputError` says that the weights or their card cannot be read or do not fit."""
    card = _of_card(load_card(weights), Path(weights).with_suffix(".json"))
    net = make_pose_net(card.pose_encoder)
    load_weights(weights, net, prefix="pose_net.")
    return net.eval().to(device), card.hr_size


@torch.inference_mode()
def predict_poses(
    net: PoseNet | EncoderPoseNet,
    size: tuple[int, int],
    paths: Sequence[str | Path],
    depth: DepthModel | None = None,
    intrinsics: np.ndarray | None = None,
    *,
    batch_size: int = 16,
) -> np.ndarray:
    """Motions between the N ≥ 3 neighbouring frames of a sequence, `batch_size` targets at a time; each frame is decoded once. Fewer are
    an `InputError`.

    Args:
        net, size: from `load_pose_net`.
        paths: N ≥ 3 consecutive frames.
        depth, intrinsics: the depth network that learned beside PoseNet, and (3, 3) in pixels of the frames; with them poses are `refined`,
            beyond the paper.

    Returns:
        (N − 2, 2, 4, 4) float64: for each frame but the first and last, as target, the pose that maps its coordinates to the previous
        frame's and to the next frame's; translations in the unit of the predicted depth, which changes with the frame without `depth`:
        there each frame's disparities are first divided by their mean.
    """
    if len(paths) < 3:
        raise InputError(f"{len(paths)} frames: PoseNet sees three at a time")
    device = next(net.parameters()).device
    frames: list[Tensor] = []
    near: list[Tensor] = []
    poses = []
    for number, path in enumerate(tqdm(paths, desc="predicting poses", unit="image"), 1):
        image = read_image(path)
        frames.append(low_resolution(to_unit(tensor_of(image, size))[None])[0])
        near += [torch.from_numpy(depth.disparities([image]))] if depth else []
        if len(frames) == batch_size + 2 or (number == len(paths) and len(frames) > 2):
            views = torch.stack([torch.stack([frames[i], frames[i - 1], frames[i + 1]]) for i in range(1, len(frames) - 1)]).to(device)
            found = net(views)
            if depth:
                share = (views.shape[-1] / image.shape[1], views.shape[-2] / image.shape[0])
                matrix = resize_intrinsics(torch.tensor(intrinsics, dtype=torch.float32, device=device), *share)
                disparity = torch.stack(near[1:-1]).to(device)
                mean = depth.card.get("mean_disparity", 1.0)
                iterations = 6 if views.shape[-2] >= LARGE else 3  # at 64×192 three are enough
                found = refined(views, disparity, found, matrix.expand(len(views), 3, 3), mean, iterations)
                found[..., :3] *= mean / disparity.mean(dim=(1, 2, 3))[:, None, None]  # their own scale changes less from frame to frame
            poses.append(pose_matrix(found.double()).cpu())
            frames, near = frames[-2:], near[-2:]
    return torch.cat(poses).numpy()


def tensor_of(image: np.ndarray, size: tuple[int, int]) -> Tensor:
    """(3, h, w) uint8 of an image (H, W, 3) uint8, resampled to `size` = (h, w)."""
    return torch.from_numpy(resample(image, size).transpose(2, 0, 1).copy())


def _of_card(card: dict[str, Any], source: object, *needed: str) -> _Card:
    """The network that a card names, all `needed` words of it, and the size of its images; an `InputError` begins with `source`."""
    try:
        if missing := [name for name in ("network", "hr_size", *needed) if name not in card]:
            raise ValueError(f"{missing[0]} is missing")
        return _Card.model_validate(card)
    except ValueError as error:
        wrong: object = error
        if isinstance(error, ValidationError):
            first = error.errors(include_url=False)[0]
            wrong = f"{'.'.join(map(str, first['loc']))}: {first['msg']}, found {first['input']!r:.60}".removeprefix(": ")
        raise InputError(f"{source}: names no network of this project ({wrong}); keep the card that was written with it") from None


def _rgb(image: Image, read: Callable[[str | Path], np.ndarray]) -> np.ndarray:
    """(H, W, 3) uint8 RGB of a file, or of an array that is checked to be that."""
    if isinstance(image, str | Path):
        return read(image)
    array = np.asarray(image)
    if array.dtype != np.uint8 or array.ndim != 3 or array.shape[2] != 3 or 0 in array.shape:
        raise InputError(f"image of shape {array.shape} and type {array.dtype}; give a file, or (H, W, 3) uint8 RGB")
    return array
