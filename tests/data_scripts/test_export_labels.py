"""Making label maps from the shell with small random models: the likeliest class of each pixel, and one line for every mistake."""

import json
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
    write_list((DRIVE, 3), (DRIVE, 0), (OTHER, 1), (DRIVE, 1))
    save(segformer())


def write_list(*frames):
    Path("list.txt").write_text("".join(f"{drive} {index:010d} l\n" for drive, index in frames))


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


@pytest.mark.parametrize("size", [None, (96, 160)])
def test_each_pixel_has_the_class_of_the_largest_logit(size):
    model = segformer()
    assert run(*(["--size", "96x160"] if size else [])) == 0
    assert sorted(Path("out").glob("*/*")) == sorted(images())
    for out, path in images().items():
        labels, expected = read_label_map(out), likeliest(model, path, size)
        assert labels.shape == expected.shape == ((208, 208) if path.endswith("png") else (150, 260))
        assert len(np.unique(expected)) > 2
        assert (labels == expected).mean() > 0.999


def test_the_batch_changes_nothing():
    run("--batch-size", "1")
    alone = {out: read_label_map(out) for out in images()}
    shutil.rmtree("out")
    run("--batch-size", "3")
    for out, labels in alone.items():
        assert (read_label_map(out) == labels).mean() > 0.999


def test_a_file_beside_the_maps_says_what_made_them():
    run()
    card = json.loads(Path("out/labels.json").read_text())
    assert card["model"] == "model" and card["revision"] is None and card["size"] == "the images' own"
    assert len(card["weights_sha256"]) == len(card["list_sha256"]) == 64
    assert card["weights_sha256"] == export_labels.weights_digest(segformer()) != export_labels.weights_digest(segformer(seed=1))


def test_maps_of_the_same_model_stay_and_what_is_missing_is_made(capsys):
    run()
    first, *others = images()
    first.unlink()
    for out in others:
        cv2.imwrite(str(out), np.full((2, 2), 7, np.uint8))
    capsys.readouterr()
    assert run() == 0
    assert "1 label maps written, 3 were there" in capsys.readouterr().out
    assert read_label_map(first).shape == (208, 208) and all(read_label_map(out).shape == (2, 2) for out in others)


def test_maps_of_another_maker_are_neither_mixed_nor_lost(refused):
    run()
    before = {path: path.read_bytes() for path in Path("out").rglob("*") if path.is_file()}
    assert "out: holds label maps of another maker (model, size the images' own" in refused(run, "--size", "64x64")
    save(segformer(seed=1))
    assert "give another folder for --out" in refused(run)
    assert before == {path: path.read_bytes() for path in Path("out").rglob("*") if path.is_file()}
    Path("out/labels.json").unlink()
    assert "it has no readable labels.json" in refused(run)


def test_other_classes_are_refused_by_name(refused):
    swapped = [*CITYSCAPES[1::-1], *CITYSCAPES[2:]]
    save(segformer(id2label=dict(enumerate(swapped)), label2id={name: i for i, name in enumerate(swapped)}))
    assert "has the 19 classes sidewalk, road, building" in refused(run)
    save(segformer(id2label={0: "road", 1: "rest"}, label2id={"road": 0, "rest": 1}))
    assert "has the 2 classes road, rest; needed are Cityscapes' 19 in order: road, sidewalk" in refused(run)
    assert not Path("out").exists()


def test_a_model_without_a_trained_head_is_refused(refused):
    SegformerModel(segformer().config).save_pretrained("model")
    assert "model: has no weights for decode_head" in refused(run)


def test_pickled_weights_are_read_only_when_allowed(refused):
    torch.save(segformer().state_dict(), "model/pytorch_model.bin")
    Path("model/model.safetensors").unlink()
    assert "--allow-pickle" in refused(run) and not Path("out").exists()
    assert run("--allow-pickle") == 0


@pytest.mark.parametrize("damaged", ["config.json", "preprocessor_config.json", "model.safetensors", "all"])
def test_what_is_no_whole_model_is_one_line(refused, damaged):
    if damaged == "model.safetensors":
        Path("model", damaged).write_bytes(Path("model", damaged).read_bytes()[:-100])
    elif damaged == "all":
        shutil.rmtree("model")
    else:
        Path("model", damaged).unlink()
    assert "model: not a usable segmentation model (" in refused(run)


def test_a_size_that_the_model_cannot_take_names_the_option_and_leaves_nothing(refused):
    error = refused(run, "--size", "16x16")  # its first attention shrinks a map of 4x4 by 8
    assert "model: cannot take images of 16x16" in error and "give its size with --size HxW" in error
    assert not Path("out").exists()


def test_missing_images_are_in_one_message_or_left_out(refused):
    write_list((DRIVE, 0), (DRIVE, 77), (OTHER, 88))
    error = refused(run)
    assert "2 of 3 files are missing" in error and "0000000077" in error and "0000000088" in error
    assert run("--allow-missing") == 0
    assert [path.name for path in Path("out").glob("*/*")] == ["0000000000.png"]


def test_both_cameras_of_a_frame_would_have_one_map(kitti_root, refused):
    write_drive(kitti_root, range(1), camera="image_03")
    Path("list.txt").write_text(f"{DRIVE} 0000000000 l\n{DRIVE} 0000000000 r\n")
    assert "list.txt: lists both cameras" in refused(run)


def test_a_damaged_image_an_odd_device_and_a_batch_of_none_are_named(refused):
    assert "device 'nothing' is not to be had" in refused(run, "--device", "nothing")
    assert "--batch-size 0" in refused(run, "--batch-size", "0")
    path = Path("kitti", DRIVE, "image_02/data/0000000003.png")
    path.write_bytes(path.read_bytes()[:100])
    assert "0000000003.png: truncated" in refused(run)
    assert not Path("out").exists()
