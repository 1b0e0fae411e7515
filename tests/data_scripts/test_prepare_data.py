"""From a folder of KITTI frames to triplets, frames to score and ground truth; and what a user is told when something is missing."""

import json
import shutil
from collections import Counter

import cv2
import numpy as np
import pytest
from small_kitti import write_sequence

from data_scripts import prepare_data
from dualdepth.cli import main as command
from dualdepth.data.depth_maps import load_ground_truth
from dualdepth.data.kitti import read_frame_list, read_image
from dualdepth.errors import InputError
from dualdepth.run import Run
from dualdepth.training.variants import training_data

TRAIN, TEST = "2011_09_26/2011_09_26_drive_0001_sync", "2011_09_26/2011_09_26_drive_0002_sync"


@pytest.fixture
def project(tmp_path, checkout, kitti_factory, write_scan):
    """A run of a profile of its own, a KITTI root with a training and a test drive, and the list of the frames to score."""
    kitti = kitti_factory({TRAIN: range(6), TEST: range(3)})
    write_scan(kitti, TEST, 0)
    write_scan(kitti, TEST, 2)
    test_list = tmp_path / "test.txt"
    test_list.write_text(f"{TEST} 0000000000 l\n{TEST} 0000000002 l\n")
    profile = tmp_path / "own.yaml"
    profile.write_text(f"about: a test\ndata: {{source: kitti, train_drives: [{TRAIN}], test_list: {test_list}}}\n")
    return Run(str(profile), checkout), kitti, test_list


def prepared(project):
    run, kitti, _ = project
    prepare_data.find_data(run, str(kitti))
    return prepare_data.prepare(run)


def test_ground_truth_is_in_the_order_of_the_list_and_training_frames_with_a_scan_fit_the_baselines(project, write_scan):
    run, kitti, _ = project
    assert prepared(project) == (4, 2, 2, 0, 0)
    maps = load_ground_truth(run.prepared / "ground_truth.npz")
    frames = json.loads((run.prepared / "test_frames.json").read_text())["frames"]
    assert [frame[1] for frame in frames] == [0, 2] and len(maps) == 2 and all((depth > 0).any() for depth in maps)
    write_scan(kitti, TRAIN, 2)
    assert prepared(project).baseline == len(load_ground_truth(run.prepared / "baseline_truth.npz")) == 1


def test_other_images_of_the_same_names_are_other_data(project):
    run, kitti, _ = project
    kept = [run.prepared / "identity.json", run.prepared / "test_frames.json"]
    for drive, changed in ((TRAIN, [True, False]), (TEST, [False, True])):
        prepared(project)
        before = [path.read_text() for path in kept]
        path = image_of(kitti, drive, 2)
        cv2.imwrite(str(path), cv2.imread(str(path)) // 2)
        prepared(project)
        assert [path.read_text() != text for path, text in zip(kept, before)] == changed


def test_frames_to_score_that_are_missing_are_all_named_in_one_line_or_allowed_and_counted(project):
    run, _kitti, test_list = project
    test_list.write_text(test_list.read_text() + f"{TEST} 0000000007 l\n{TEST} 0000000008 l\n")
    with pytest.raises(InputError, match=r"4 files .*image_02/data 0000000007-0000000008; .*velodyne_points/data 0000000007-0000000008"):
        prepared(project)
    assert not (run.prepared / "ground_truth.npz").exists()
    run.profile = run.profile.model_copy(update={"data": run.profile.data.model_copy(update={"allow_missing": True})})
    assert prepared(project)[1:3] == (2, 4)


def test_a_drive_cannot_be_both_trained_on_and_scored(project, write_scan):
    _, kitti, test_list = project
    write_scan(kitti, TRAIN, 1)
    test_list.write_text(f"{TRAIN} 0000000001 l\n")
    with pytest.raises(InputError, match=rf"drives {TRAIN} are both trained on and scored"):
        prepared(project)


@pytest.mark.parametrize(("option", "value"), [("--kitti-root", "nowhere"), ("--test-list", "nowhere.txt"), ("--seeds", "0;1")])
def test_reproduce_refuses_bad_arguments_in_one_line(option, value, refused):
    assert value in refused(command, ["reproduce", option, value])


def test_the_sample_profile_on_real_frames(real, checkout):
    run, root, listed = Run("sample", checkout), real("kitti_raw"), real("splits/sample_val.txt")
    there = [{int(path.stem) for path in (root / drive / "image_02/data").iterdir()} for drive in run.profile.data.train_drives]
    triplets, scored = sum({i - 1, i + 1} <= numbers for numbers in there for i in numbers), len(read_frame_list(listed))
    prepare_data.find_data(run, str(root), str(listed))
    assert prepare_data.prepare(run) == (triplets, scored, scored, 0, 0)
    density = [np.mean(depth > 0) for depth in load_ground_truth(run.prepared / "ground_truth.npz")]
    assert min(density) > 0.02


def image_of(kitti, drive, index):
    return kitti / drive / f"image_02/data/{index:010d}.png"


def cut(path):
    path.write_bytes(path.read_bytes()[:100])


def spoil_size(path):
    cv2.imwrite(str(path), read_image(path)[:90, :100])


SPOILT = {
    "truncated": cut,
    "has 100×90 pixels, most of its folder 208×208": spoil_size,
    "no such file": lambda path: path.unlink() or path.symlink_to("a disk that is not there"),
}


@pytest.mark.parametrize("why", SPOILT)
def test_every_frame_is_decoded_once_and_triplets_of_broken_ones_are_left_out_and_named_in_one_line(project, monkeypatch, capsys, why):
    run, kitti, _ = project
    spoilt, seen = [image_of(kitti, TRAIN, index) for index in (5, 3)], Counter()
    for path in spoilt:
        SPOILT[why](path)
    monkeypatch.setattr(prepare_data, "read_image", lambda path: seen.update([path]) or read_image(path))
    assert prepared(project).triplets == 1
    assert seen == Counter([*(image_of(kitti, TRAIN, k) for k in range(6)), image_of(kitti, TEST, 0), image_of(kitti, TEST, 2)])
    told = [line for line in capsys.readouterr().out.splitlines() if "broken" in line]
    assert len(told) == 1 and told[0].startswith("2 frames are broken") and all(f"{path}: {why}" in told[0] for path in spoilt)
    triplets, drives = training_data(run, "lr")  # what a training and its card go by
    assert [triplet.name[-10:] for triplet in triplets] == ["0000000001"] and drives == [TRAIN]


def test_a_broken_frame_to_score_is_refused_beside_all_others(project):
    run, kitti, _ = project
    spoilt = [image_of(kitti, TEST, 2), image_of(kitti, TRAIN, 0)]
    for path in spoilt:
        cut(path)
    with pytest.raises(InputError, match="1 frames to score are broken, and 1 others") as error:
        prepared(project)
    assert all(str(path) in str(error.value) for path in spoilt) and not run.prepared.exists()


def test_frames_to_score_may_have_several_sizes_but_without_a_whole_triplet_nothing_is_prepared(project):
    run, kitti, _ = project
    spoil_size(image_of(kitti, TEST, 2))
    for index in (1, 4):
        cut(image_of(kitti, TRAIN, index))
    with pytest.raises(InputError, match="kitti: all 4 triplets have broken frames"):
        prepared(project)
    assert not run.prepared.exists()


@pytest.fixture
def with_odometry(project, tmp_path):
    """Makes a run of the project with odometry sequences, and the folder of these."""
    run, kitti, test_list = project
    root, path = tmp_path / "odometry", tmp_path / "odo.yaml"
    write_sequence(root, "00", range(5))
    write_sequence(root, "09", range(3))

    def make(test="['09']", trained="odometry_lr: ", allow_leak=False):
        data = f"{{source: kitti, train_drives: [{TRAIN}], test_list: {test_list}, odometry_train: ['00'], odometry_test: {test}}}"
        mine = "variants: {mine: {label: a, about: b, network: lr, trains_on: odometry}}"
        path.write_text(f"about: a test\ndata: {data}\ntrain: {{lr: , {trained}}}\n{mine}\n")
        made = Run(str(path), run.root)
        prepare_data.find_data(made, str(kitti), odometry_root=str(root), allow_leak=allow_leak)
        return made

    return make, root


def test_odometry_triplets_are_written_where_they_are_trained_on(with_odometry):
    (make, _), identities = with_odometry, set()
    for trained, expected in (("odometry_lr: ", 3), ("mine: ", 3), ("", 0)):
        run = make(trained=trained)
        assert prepare_data.prepare(run).odometry == expected and (run.prepared / "odometry.csv").exists() == bool(expected)
        identities.add((run.prepared / "identity.json").read_text())
    assert len(identities) == 1  # so that networks of depth are not trained again for odometry's frames


def test_broken_frames_of_odometry_are_named_and_left_out_too(with_odometry, project, capsys):
    make, root = with_odometry
    spoilt = [root / "sequences/00/image_2/000004.png", image_of(project[1], TRAIN, 0)]
    for path in spoilt:
        cut(path)
    assert prepare_data.prepare(make())[::4] == (3, 2)
    told = capsys.readouterr().out
    assert told.startswith("2 frames are broken") and all(str(path) in told for path in spoilt)
    cut(root / "sequences/09/image_2/000001.png")
    with pytest.raises(InputError, match=r"1 frames to score are broken, and 2 others: .*sequences/09/image_2/000001\.png"):
        prepare_data.prepare(make())


def test_a_scored_sequence_must_be_there_with_its_poses_and_not_be_trained_on_unless_allowed(with_odometry):
    make, root = with_odometry
    with pytest.raises(InputError, match="sequences/10/image_2: no images"):
        prepare_data.prepare(make(test="['10']"))
    with pytest.raises(InputError, match=r"sequences 00 are both trained on and scored.*ALLOW_LEAK=1"):
        prepare_data.prepare(make(test="['00']"))
    assert prepare_data.prepare(make(test="['00']", allow_leak=True)).odometry == 3
    poses = root / "poses/09.txt"
    lines = poses.read_text().splitlines(keepends=True)
    poses.unlink()
    with pytest.raises(InputError, match=r"09\.txt: the true poses of sequence 09"):
        prepare_data.prepare(make())
    poses.write_text("".join(lines[:2]))
    with pytest.raises(InputError, match=r"09\.txt: has 2 poses, but the sequence has a frame 2"):
        prepare_data.prepare(make())
    (root / "sequences/09/image_2/000001.png").unlink()
    with pytest.raises(InputError, match="image_2: frame 1 is missing"):
        prepare_data.prepare(make())


@pytest.mark.parametrize("roots", [{"kitti_root": "a"}, {"odometry_root": "a", "labels_root": "b"}])
def test_the_world_has_its_own_folders_and_takes_no_others(tmp_path, roots):
    with pytest.raises(InputError, match=f"profile tiny makes its own data: {' and '.join(roots).upper().replace(' AND ', ' and ')}"):
        prepare_data.find_data(Run("tiny", tmp_path), **roots)


@pytest.mark.parametrize("name", ["make3d_root", "odometry_root", "labels_root"])
def test_a_folder_of_another_benchmark_is_checked_at_once(project, tmp_path, name):
    run, kitti, _ = project
    with pytest.raises(InputError, match=f"{name.upper()} {tmp_path}: holds no"):
        prepare_data.find_data(run, str(kitti), **{name: str(tmp_path)})


def test_every_scored_frame_needs_its_label_map(project, tmp_path):
    run, kitti, test_list = project
    labels = tmp_path / "labels" / TEST.split("/")[1]
    labels.mkdir(parents=True)
    (labels / "0000000000.png").touch()
    prepare_data.find_data(run, str(kitti), labels_root=str(labels.parent))
    with pytest.raises(InputError, match=r"0000000002\.png: no label map, nor have 0 other scored frames"):
        prepare_data.prepare(run)
    (labels / "0000000002.png").touch()
    prepare_data.prepare(run)
    shutil.copytree(kitti / TEST / "image_02", kitti / TEST / "image_03")
    test_list.write_text(test_list.read_text() + f"{TEST} 0000000002 r\n")
    with pytest.raises(InputError, match=r"test\.txt: lists both cameras of a frame"):
        prepare_data.prepare(run)
