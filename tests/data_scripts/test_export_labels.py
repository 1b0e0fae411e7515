"""Making label maps from the shell with small random models: the likeliest class of each pixel, and one line for every mistake."""

import json
import os
import shutil
from pathlib import Path

import cv2
import huggingface_hub
import numpy as np
import pytest
import torch
from PIL import Image
from small_kitti import DRIVE, write_drive
from torch.nn.functional import interpolate
from transformers import SegformerConfig, SegformerForSemanticSegmentation, SegformerModel
from transformers import SegformerImageProcessorPil as Processor

from data_scripts import export_labels
from dualdepth.data.kitti import read_frame_list
from dualdepth.data.label_maps import CITYSCAPES, label_path, read_label_map

OTHER = "2011_09_26/2011_09_26_drive_0002_sync"
NAMES = {"id2label": dict(enumerate(CITYSCAPES)), "label2id": {name: i for i, name in enumerate(CITYSCAPES)}}
BLOCKS = {"depths": [1, 1, 1, 1], "hidden_sizes": [8, 8, 16, 16]}


def segformer(seed=0, **settings):
    torch.manual_seed(seed)
    config = SegformerConfig(**BLOCKS, num_attention_heads=[1, 1, 2, 2], decoder_hidden_size=16, initializer_range=0.5, **NAMES | settings)
    return SegformerForSemanticSegmentation(config).eval()


def save(model, folder="model"):
    model.save_pretrained(folder)
    Processor(size={"height": 64, "width": 64}).save_pretrained(folder)


@pytest.fixture(autouse=True)
def kitti(tmp_path, monkeypatch, kitti_root):
    """A root with frames of two sizes, a list of them, and a model, in the working directory; none is sought on the hub."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", True)
    write_drive(kitti_root, range(2), OTHER, size=(150, 260), suffix=".jpg")
    frames = ((DRIVE, 3), (DRIVE, 0), (OTHER, 1), (DRIVE, 1))
    Path("list.txt").write_text("".join(f"{drive} {index:010d} l\n" for drive, index in frames))
    save(segformer())


def run(*arguments):
    return export_labels.main(["--kitti", "kitti", "--list", "list.txt", "--out", "out", "--model", "model", "--device", "cpu", *arguments])


def images():
    """Image files of the list by where their maps go."""
    suffix = {DRIVE: "png", OTHER: "jpg"}
    return {label_path("out", f): f"kitti/{f.drive}/image_02/data/{f.index:010d}.{suffix[f.drive]}" for f in read_frame_list("list.txt")}


@torch.inference_mode()
def likeliest(model, path, size=None):
    """The label map of an image, by hand: ImageNet's mean and standard deviation, bilinear logits, argmax."""
    image = Image.fromarray(cv2.imread(path)[..., ::-1])
    shape = image.size[::-1]
    if size:
        image = image.resize(size[::-1], Image.Resampling.BILINEAR)
    pixels = (np.asarray(image) / 255 - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]
    logits = model(torch.tensor(pixels.transpose(2, 0, 1)[None], dtype=torch.float32)).logits
    return interpolate(logits, shape, mode="bilinear", align_corners=False)[0].argmax(0).numpy()


@pytest.mark.parametrize(("size", "batch"), [(None, "1"), (None, "3"), ((96, 160), "3")])
def test_each_pixel_has_the_class_of_the_largest_logit_whatever_the_batch(size, batch):
    model = segformer()
    run("--batch-size", batch, *(["--size", "96x160"] if size else []))
    assert sorted(Path("out").glob("*/*")) == sorted(images())
    for out, path in images().items():
        labels, expected = read_label_map(out), likeliest(model, path, size)
        assert labels.shape == expected.shape == ((208, 208) if path.endswith("png") else (150, 260))
        assert len(np.unique(expected)) > 2 and (labels == expected).mean() > 0.999


def test_a_file_says_what_made_the_maps_which_stay_and_are_neither_mixed_with_those_of_another_maker_nor_lost(capsys, refused):
    run()
    card = json.loads(Path("out/labels.json").read_text())
    assert card["model"] == "model" and card["revision"] is None and card["size"] == "the images' own" and len(card["list_sha256"]) == 64
    assert card["weights_sha256"] == export_labels.weights_digest(segformer()) != export_labels.weights_digest(segformer(seed=1))
    first, *others = images()
    first.unlink()
    for out in others:
        cv2.imwrite(str(out), np.full((2, 2), 7, np.uint8))
    run()
    assert "1 label maps written, 3 were there" in capsys.readouterr().out
    assert read_label_map(first).shape == (208, 208) and all(read_label_map(out).shape == (2, 2) for out in others)
    before = {path: path.read_bytes() for path in Path("out").rglob("*.png")}
    assert "out: holds label maps of another maker" in refused(run, "--size", "64x64")
    save(segformer(seed=1))
    assert "give another folder for --out" in refused(run)
    Path("out/labels.json").unlink()
    assert "labels.json: no such file" in refused(run)
    assert before == {path: path.read_bytes() for path in Path("out").rglob("*.png")}


def of_classes(*names):
    save(segformer(id2label=dict(enumerate(names)), label2id={name: i for i, name in enumerate(names)}))


BAD_MODELS = {
    "classes in another order": (lambda: of_classes(*CITYSCAPES[1::-1], *CITYSCAPES[2:]), "has the 19 classes sidewalk, road, building"),
    "other classes": (lambda: of_classes("road", "rest"), "has the 2 classes road, rest; needed are Cityscapes' 19 in order: road"),
    "without a trained head": (lambda: SegformerModel(segformer().config).save_pretrained("model"), "has no weights for decode_head"),
    "no processor": (lambda: Path("model/preprocessor_config.json").unlink(), "cannot be read"),
    "weights cut": (lambda: os.truncate("model/model.safetensors", 1000), "cannot be read"),
    "nothing": (lambda: shutil.rmtree("model"), "cannot be read"),
}


@pytest.mark.parametrize("case", BAD_MODELS)
def test_a_model_that_does_not_do_is_one_line(refused, case):
    spoil, said = BAD_MODELS[case]
    spoil()
    assert f"model: {said}" in refused(run) and not Path("out").exists()


def test_pickled_weights_are_read_only_when_allowed(refused):
    torch.save(segformer().state_dict(), "model/pytorch_model.bin")
    Path("model/model.safetensors").unlink()
    assert "--allow-pickle" in refused(run) and not Path("out").exists()
    run("--allow-pickle")


def test_both_cameras_of_a_frame_would_have_one_map(kitti_root, refused):
    write_drive(kitti_root, range(1), camera="image_03")
    Path("list.txt").write_text(f"{DRIVE} 0000000000 l\n{DRIVE} 0000000000 r\n")
    assert "list.txt: lists both cameras" in refused(run)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--device", "nothing"], "device 'nothing' is not to be had"),
        (["--batch-size", "0"], "--batch-size 0"),
        (["--size", "16x16"], "cannot take 2 images of 16x16"),  # the first attention shrinks a map of 4x4 by 8
        ([], "0000000003.png: truncated"),
    ],
)
def test_an_odd_option_and_a_damaged_image_are_named_and_leave_nothing(refused, options, said):
    path = Path("kitti", DRIVE, "image_02/data/0000000003.png")
    if not options:
        path.write_bytes(path.read_bytes()[:100])
    assert said in refused(run, *options) and not Path("out").exists()
