"""Depth of images with trained weights: `load(weights).predict(image)`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from huggingface_hub import ModelCard, ModelHubMixin, hf_hub_download
from torch import nn

from dualdepth.data.kitti import read_image
from dualdepth.device import Precision, choose_device, inference_precision
from dualdepth.errors import InputError
from dualdepth.evaluation.depth import resize_bilinear
from dualdepth.inference.predict import DepthNet, disparities_of, load_depth_net
from dualdepth.networks.architecture import Architecture
from dualdepth.training.weights import HUB_CARD, load_card, save_weights

UNIT = 16.0
"""Relative depth is reported as 16 / disparity (1.6 … 1600). Stored as uint16 × 256, as KITTI's, that resolves near depths to 0.25 %."""
WEIGHTS = "model.safetensors"
HUB_OPTIONS = ("revision", "cache_dir", "token", "local_files_only", "force_download")
"""What `from_pretrained` hands to the model hub."""
README = """---
library_name: dualdepth
pipeline_tag: depth-estimation
---

# {title}

{about}

```python
import dualdepth
model = dualdepth.load("this folder or hub name")
depth = model.predict("street.jpg")  # (H, W) float32, relative depth
```

`{card}` says which network it is, which drives it was trained on, and by which revision and settings.
"""


class DepthModel(ModelHubMixin):
    """A depth network with its card: images in, relative depth out. `dualdepth.load` makes one from weights.

    Args:
        card: names the network (`network`, `encoder`, `link`, `similarity`, `normalise`, as far as they are not the defaults of
            `networks.architecture.Architecture`) and `hr_size`, [height, width] in pixels of the images that it sees.
        net: the network that the card names; None makes one with random weights.
        device: such as `cpu`, `cuda`, `cuda:1`, `mps`; None takes a GPU where there is one.
        precision: `float32` or `bf16`; None takes bf16 on a CUDA GPU that has it, else float32, in which the tables are scored.

    Raises:
        InputError: the card names no network of this project, or the device or precision is not to be had.

    >>> import tempfile, numpy as np, dualdepth
    >>> model = dualdepth.DepthModel({"network": "hr", "hr_size": [192, 288]}, device="cpu")  # untrained
    >>> model.about
    'Depth is relative: its unit is unknown. The card does not say what these weights were learned from.'
    >>> image = np.zeros((60, 200, 3), np.uint8)
    >>> depth = model.predict(image)
    >>> depth.shape, depth.dtype.name, bool((depth > 0).all())
    ((60, 200), 'float32', True)

    It is saved with its card, and loaded from a folder or from the model hub:

    >>> with tempfile.TemporaryDirectory() as folder:
    ...     model.save_pretrained(folder)
    ...     again = dualdepth.DepthModel.from_pretrained(folder, device="cpu")
    >>> bool((again.predict(image) == depth).all())
    True
    """

    def __init__(
        self,
        card: dict[str, Any],
        net: nn.Module | None = None,
        *,
        device: str | torch.device | None = None,
        precision: Precision | None = None,
    ) -> None:
        try:
            self.architecture = Architecture.of_card(card)
            height, width = map(int, card["hr_size"])
            if min(height, width) < 192 or height % 96 or width % 96:
                raise ValueError(f"hr_size [{height}, {width}]: both sides must be multiples of 96, at least 192")
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"the card names no network of this project ({error}); give network and hr_size") from None
        self.card = card | self.architecture.model_dump()
        """What is known of the weights."""
        self.size = height, width
        """(height, width) that images are resized to."""
        self.device = choose_device(device)
        self.precision = inference_precision(precision, self.device)
        self.net = (net or self.architecture.build()).eval().to(self.device)

    @property
    def about(self) -> str:
        """That depth is relative, and what it was learned from, in one line."""
        learned = self.card.get("about")
        learned = f"Learned by {learned}." if learned else "The card does not say what these weights were learned from."
        start = " The encoder began with ImageNet weights." if self.card.get("pretrained") else ""
        return f"Depth is relative: its unit is unknown. {learned}{start}"

    def __repr__(self) -> str:
        return f"DepthModel({self.architecture.network}, {self.size[1]}×{self.size[0]}, {self.device}, {self.precision}): {self.about}"

    def predict(self, image: str | Path | np.ndarray) -> np.ndarray:
        """Depth of one image.

        Args:
            image: an image file (turned as its EXIF data say; grey, 16-bit and transparent ones are read as 8-bit RGB), or (H, W, 3)
                uint8 RGB. Any size and aspect ratio: it is resized to the network's size.

        Returns:
            (H, W) float32, positive: depth in an unknown unit (16 / the network's disparity, so from 1.6 to 1600), at the image's size.

        Raises:
            InputError: the file is missing, broken or no image, or the array is of another shape or type.
        """
        return self.predict_batch([image])[0]

    @torch.inference_mode()
    def predict_batch(self, images: Sequence[str | Path | np.ndarray]) -> list[np.ndarray]:
        """Depths of some images, of any sizes, computed together; see `predict`."""
        arrays = [_rgb(image) for image in images]
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.precision == "bf16"):
            disparities = disparities_of(DepthNet(self.net, self.architecture, self.size), arrays, self.device)
        if not np.isfinite(disparities).all():
            raise InputError(f"the network's numbers are not finite in {self.precision}; its weights are damaged or need float32")
        return [resize_bilinear(np.float32(UNIT) / disparity, array.shape[:2]) for disparity, array in zip(disparities, arrays)]

    @classmethod
    def from_pretrained(
        cls, name: str | Path, *, device: str | torch.device | None = None, precision: Precision | None = None, **hub: Any
    ) -> "DepthModel":
        """Load a file or folder that `save_pretrained` or a training has written, or a model of the model hub.

        Args:
            name: the file or folder, or `owner/name`.
            device, precision: as of the class.
            hub: `revision`, `cache_dir`, `token`, `local_files_only`, `force_download`.

        Raises:
            InputError: it is not there, cannot be had, or is not of this project.
        """
        if unknown := sorted(hub.keys() - HUB_OPTIONS):
            raise TypeError(f"from_pretrained() has no option {', '.join(unknown)}; there are device, precision, {', '.join(HUB_OPTIONS)}")
        path = Path(name)
        if path.is_dir():
            path /= WEIGHTS
        elif not path.is_file():
            if path.is_absolute() or path.suffix == ".safetensors":
                raise InputError(f"{name}: no such weights; give {WEIGHTS} of a training, its folder, or a name on the model hub")
            try:
                hf_hub_download(str(name), HUB_CARD, **hub)
                path = Path(hf_hub_download(str(name), WEIGHTS, **hub))
            except (OSError, ValueError) as error:  # no network, no such name
                reason = next(iter(str(error).splitlines()), type(error).__name__)
                raise InputError(f"{name}: no folder, and not to be had from the model hub ({reason}); check the name") from None
        return cls(load_card(path), load_depth_net(path).net, device=device, precision=precision)

    def _save_pretrained(self, save_directory: Path) -> None:
        card = {key: value for key, value in self.card.items() if key != "sha256"} | {"hr_size": list(self.size)}
        save_weights(save_directory / WEIGHTS, nn.ModuleDict({"depth_net": self.net}), card, HUB_CARD)

    def generate_model_card(self, *_args: Any, **_kwargs: Any) -> ModelCard:
        """The page that the model hub shows."""
        title = f"dualdepth: {self.card.get('variant', self.architecture.network)}"
        return ModelCard(README.format(title=title, about=self.about, card=HUB_CARD))


def load(weights: str | Path, device: str | torch.device | None = None, precision: Precision | None = None) -> DepthModel:
    """Load trained weights.

    Args:
        weights: a `.safetensors` file with its card beside it (`<name>.json`, or `config.json`), as
            `work/<profile>/runs/<variant>/seed<n>/model.safetensors`; the folder of one; or a name on the model hub, `owner/name`.
        device: such as `cpu`, `cuda`, `cuda:1`, `mps`; None takes a GPU where there is one.
        precision: `float32` or `bf16`; None takes bf16 on a CUDA GPU that has it, else float32.

    Returns:
        The model; `predict(image)` gives (H, W) float32 relative depth, `about` says what it was learned from.

    Raises:
        InputError: the weights or their card are missing, damaged, changed (sha256) or of another network, or the device or precision
            is not to be had.

    >>> import tempfile, numpy as np, dualdepth
    >>> folder = tempfile.TemporaryDirectory()
    >>> dualdepth.DepthModel({"network": "hr", "hr_size": [192, 288]}).save_pretrained(folder.name)  # stands for trained weights
    >>> model = dualdepth.load(folder.name)
    >>> model.predict(np.zeros((375, 1242, 3), np.uint8)).shape
    (375, 1242)
    >>> folder.cleanup()
    """
    return DepthModel.from_pretrained(weights, device=device, precision=precision)


def _rgb(image: str | Path | np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8 RGB of a file, or of an array that is checked to be that."""
    if isinstance(image, str | Path):
        return read_image(image)
    array = np.asarray(image)
    if array.dtype != np.uint8 or array.ndim != 3 or array.shape[2] != 3 or 0 in array.shape:
        raise InputError(f"image of shape {array.shape} and type {array.dtype}; give a file, or (H, W, 3) uint8 RGB")
    return array
