"""Write label maps (Cityscapes training ids) of a list of KITTI raw images with a pretrained segmentation model of `transformers`.

    python data_scripts/export_labels.py --kitti ROOT --list FILE --out LABELS_ROOT [--model NAME]

One 8-bit PNG of the image's size an image, `<drive>/<frame>.png`, and `labels.json`, which says what made them. The paper used PSPNet.
"""

import argparse
import hashlib
import json
import re
from collections.abc import Iterator, Sequence
from itertools import groupby, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from PIL import Image
from tqdm import tqdm

from data_scripts.export_depth import present_frames
from dualdepth.data.kitti import check_root, image_path, read_frame_list, read_image
from dualdepth.data.label_maps import CITYSCAPES, label_path
from dualdepth.device import choose_device, default_device
from dualdepth.errors import InputError, exit_on_input_error, reading
from dualdepth.files import atomic_path, file_digest, write_json

if TYPE_CHECKING:
    import torch

MODEL = "nvidia/segformer-b5-finetuned-cityscapes-1024-1024"
Size = tuple[int, int] | None  # (height, width) that images are resized to for the model; None: their own, so that nothing is stretched.


class Segmenter(NamedTuple):
    """A segmentation model, the processor of its images, and for `labels.json` its name, revision, sha256 of the weights, versions."""

    model: Any
    processor: Any
    facts: dict[str, Any]


def load_segmenter(model: str, *, revision: str, device: str | None, allow_pickle: bool) -> Segmenter:
    """Load a model by hub name or local folder.

    Raises:
        InputError: it or the device cannot be had, it lacks weights, or its classes are not Cityscapes' 19 in the training ids' order.
    """
    import transformers
    from transformers import AutoConfig, AutoImageProcessor, AutoModelForSemanticSegmentation

    transformers.utils.logging.set_verbosity_error()
    transformers.utils.logging.disable_progress_bar()  # a bar in a pipe would break the one-line error
    place, shared = choose_device(device or default_device()), {"revision": revision, "trust_remote_code": False}
    mend = "give a segmentation model of transformers" + "; weights must be safetensors unless --allow-pickle is given" * (not allow_pickle)
    with reading(model, mend):
        config = AutoConfig.from_pretrained(model, **shared)
        classes = [str(config.id2label[i]) for i in sorted(config.id2label)]
        if tuple(re.sub("[-_]", " ", name.lower()) for name in classes) != CITYSCAPES:
            shown = ", ".join(classes[: len(CITYSCAPES)]) + ", …" * (len(classes) > len(CITYSCAPES))
            needed = f"Cityscapes' {len(CITYSCAPES)} in order: {', '.join(CITYSCAPES)}"
            raise InputError(f"{model}: has the {len(classes)} classes {shown}; needed are {needed}")
        processor = AutoImageProcessor.from_pretrained(model, backend="pil", **shared)
        network, loading = AutoModelForSemanticSegmentation.from_pretrained(
            model, use_safetensors=None if allow_pickle else True, dtype="float32", output_loading_info=True, **shared
        )
    if loading["missing_keys"]:
        raise InputError(f"{model}: has no weights for {sorted(loading['missing_keys'])[0]}; give a model trained on Cityscapes")
    versions = {"revision": getattr(config, "_commit_hash", None), "transformers": transformers.__version__}
    return Segmenter(network.eval().to(place), processor, {"model": model, "weights_sha256": weights_digest(network), **versions})


def weights_digest(model: "torch.nn.Module") -> str:
    """sha256 of all weights by name, however they are stored in files."""
    import torch

    digest = hashlib.sha256()
    for key, value in sorted(model.state_dict().items()):
        digest.update(f"{key} {value.dtype} {tuple(value.shape)}".encode())
        digest.update(value.cpu().contiguous().view(-1).view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()


def segment(segmenter: Segmenter, images: Sequence[np.ndarray], size: Size = None) -> np.ndarray:
    """Training ids (N, H, W) uint8 of N images (H, W, 3) uint8 of one size, which are resized to `size` (height, width) for the model.

    They are the likeliest classes after the logits were resized to the images' size bilinearly.

    Raises:
        InputError: the model cannot take this size.
    """
    import torch

    model, processor, facts = segmenter
    shape = images[0].shape[:2]
    height, width = size or shape
    resize = {"do_resize": bool(size), "size": {"height": height, "width": width}}
    whole = {name: False for name in ("do_center_crop", "do_pad") if getattr(processor, name, None)}
    try:
        pixels = processor(images=list(images), return_tensors="pt", **resize, **whole)["pixel_values"]
        if pixels.shape[-2:] != (height, width):
            raise ValueError(f"its processor gives {pixels.shape[-2]}x{pixels.shape[-1]}")
        with torch.inference_mode():
            logits = model(pixels.to(model.device)).logits
            resized = torch.nn.functional.interpolate(logits, shape, mode="bilinear", align_corners=False)
    except (ValueError, RuntimeError) as error:  # torch's of no memory among them
        why = next(iter(str(error).splitlines()), type(error).__name__)
        mend = "give its size with --size HxW, or a smaller --batch-size"
        raise InputError(f"{facts['model']}: cannot take {len(images)} images of {height}x{width} ({why}); {mend}") from None
    return resized.argmax(1).to(torch.uint8).cpu().numpy()


def label_maps(segmenter: Segmenter, images: dict[Path, Path], size: Size, batch_size: int) -> Iterator[tuple[Path, np.ndarray]]:
    """Where each map goes, and the map (H, W) uint8, for `images` by where their maps go; a batch holds images of one size."""
    read = ((out, read_image(path)) for out, path in images.items())
    for _, alike in groupby(read, key=lambda pair: pair[1].shape):
        while batch := list(islice(alike, batch_size)):
            outs, pictures = zip(*batch)
            yield from zip(outs, segment(segmenter, pictures, size))


def wanted_maps(kitti: str | Path, frame_list: str | Path, out: Path, allow_missing: bool) -> dict[Path, Path]:
    """Image files of a list by where their label maps go.

    Raises:
        InputError: images are missing, or two cameras' images would have one map.
    """
    frames, root, images = read_frame_list(frame_list), check_root(kitti), {}
    paths = [image_path(root, frame) for frame in frames]
    for number in present_frames(paths, frames, allow_missing):
        path = label_path(out, frames[number])
        if images.setdefault(path, paths[number]) != paths[number]:
            raise InputError(f"{frame_list}: lists both cameras of {frames[number].drive} {frames[number].index}; there is one map a frame")
    return images


def check_maker(out: Path, facts: dict[str, Any]) -> None:
    """Refuse a folder that holds another model's maps, so that none are mixed or lost.

    Raises:
        InputError: naming what made those that are there.
    """
    if any(out.glob("*/*.png")):
        with reading(out / "labels.json", f"{out} holds label maps whose maker is unknown: give another folder for --out"):
            made = json.loads((out / "labels.json").read_text(encoding="utf-8"))
            maker = {key: made.get(key) for key in ("model", "weights_sha256", "size")}
        if maker != {key: facts[key] for key in maker}:
            raise InputError(f"{out}: holds label maps of another maker ({json.dumps(maker)}); give another folder for --out")


def height_width(text: str) -> tuple[int, int]:
    """`384x1248` as (384, 1248)."""
    match = re.fullmatch(r"([1-9]\d*)x([1-9]\d*)", text)
    if not match:
        raise argparse.ArgumentTypeError(f"{text!r} is not HEIGHTxWIDTH, such as 512x1024")
    return int(match[1]), int(match[2])


def main(argv: list[str] | None = None) -> None:
    """Run the command line; bad input is one line on stderr and exit code 2."""
    parser = argparse.ArgumentParser(description="Write Cityscapes label maps of KITTI raw images with a pretrained segmentation model.")
    add = parser.add_argument
    add("--kitti", required=True, metavar="ROOT", help="folder that holds 2011_09_26, 2011_09_28, …")
    lines = "lines like `2011_09_26/2011_09_26_drive_0052_sync 0000000000 l`"
    add("--list", dest="frame_list", required=True, metavar="FILE", help=lines)
    add("--out", required=True, type=Path, metavar="LABELS_ROOT", help="folder to write to")
    add("--model", default=MODEL, help="hub name or local folder of a semantic-segmentation model (default: %(default)s)")
    add("--revision", default="main", help="branch, tag or commit of the model on the hub (default: %(default)s)")
    size = "resize images for the model (default: their own size, so that nothing is stretched)"
    add("--size", type=height_width, metavar="HxW", help=size)
    add("--device", help="cpu, cuda, cuda:1, … (default: cuda where there is one)")
    add("--batch-size", type=int, default=4, metavar="N", help="images at once (default: %(default)s)")
    add("--allow-missing", action="store_true", help="leave out frames whose image is missing; else they are an error")
    add("--allow-pickle", action="store_true", help="read weights that are no safetensors; only from a source you trust")
    with exit_on_input_error():
        given = parser.parse_args(argv)
        if given.batch_size < 1:
            raise InputError(f"--batch-size {given.batch_size}: must be 1 or more")
        images = wanted_maps(given.kitti, given.frame_list, given.out, given.allow_missing)
        segmenter = load_segmenter(given.model, revision=given.revision, device=given.device, allow_pickle=given.allow_pickle)
        size = list(given.size) if given.size else "the images' own"
        check_maker(given.out, facts := segmenter.facts | {"size": size, "list_sha256": file_digest(Path(given.frame_list))})
        wanted = {path: image for path, image in images.items() if not path.is_file()}  # maps of the same model that are there stay
        maps = label_maps(segmenter, wanted, given.size, given.batch_size)
        try:
            for number, (path, labels) in enumerate(tqdm(maps, "label maps", len(wanted), unit="image", disable=None)):
                if not number:
                    write_json(given.out / "labels.json", facts)
                with atomic_path(path) as partial:
                    Image.fromarray(labels).save(partial)
        except OSError as error:
            raise InputError(f"{given.out}: cannot write the label maps ({error.strerror or error})") from None
        there = len(images) - len(wanted)
        print(f"{given.out}: {len(wanted)} label maps written" + f", {there} were there" * bool(there))


if __name__ == "__main__":
    main()
