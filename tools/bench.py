"""Speed, measured in one run on the machine at hand: `make bench`. Quote ratios and medians, not single times."""

import argparse
import multiprocessing
import resource
import statistics
import sys
import tempfile
import time
import timeit
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import torch
from torch import nn
from torch.utils.data import default_collate

from dualdepth.data.loading import TripletDataset
from dualdepth.data.triplets import Triplet
from dualdepth.device import Precision, default_device, device_name, has_bf16, keep_freed_memory
from dualdepth.evaluation.cost import count
from dualdepth.files import write_text
from dualdepth.geometry import low_resolution, resize_intrinsics, to_unit
from dualdepth.networks.architecture import Architecture
from dualdepth.networks.depth_nets import DualNet, LRNet
from dualdepth.networks.pose_net import PoseNet
from dualdepth.profile import Profile, load_profile
from dualdepth.settings import Loss, Training
from dualdepth.tables.backbone import let_see
from dualdepth.training.stages import Stage
from tools.peer import Peer


def write_frames(folder: Path) -> Triplet:
    """Three JPEG frames of KITTI's size (quality 92, as the field stores them): a smooth scene with noise, hard enough to decode."""
    rng = np.random.default_rng(0)
    scene = cv2.resize(rng.integers(0, 255, (47, 156, 3), np.uint8), (1242, 375), interpolation=cv2.INTER_CUBIC)
    paths = []
    for number in range(3):
        frame = np.roll(scene, 4 * number, axis=1).astype(np.int16) + rng.integers(-12, 12, scene.shape)
        paths.append(folder / f"{number:010d}.jpg")
        cv2.imwrite(str(paths[-1]), frame.clip(0, 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 92])
    return Triplet("bench", (paths[1], paths[0], paths[2]), np.array([[721.5, 0, 609.6], [0, 721.5, 172.9], [0, 0, 1.0]]))


def make_net(name: str, encoder: str = "resnet50") -> nn.Module:
    """A depth network for high resolution with new weights: `dual` with an encoder in it, or an encoder's name."""
    return (Architecture(network="dual", encoder=encoder) if name == "dual" else Architecture(network="single", encoder=name)).build()


def timed_steps(name: str, training: Training, batch: dict[str, Any], device: torch.device, repeats: int) -> dict[str, list[float]]:
    """Times a training step with new weights: of stage 1 (`lr`), or of stage 2 of a network for high resolution (`make_net`).

    Returns:
        Seconds of the whole (`step`) and of its parts (`networks`, `losses`, `backward`, `optimiser`), each time, and `peak_mb`: the
        GPU's peak in 10⁶ bytes, or the process's, which should then be a fresh one.
    """
    keep_freed_memory()  # as a training does
    torch.manual_seed(0)
    depth_net = LRNet(training.encoder) if name == "lr" else let_see(make_net(name, training.encoder), to_unit(batch["images"][:, 0].cpu()))
    stage = Stage(depth_net, PoseNet(), training, low=name == "lr").to(device).train()
    if training.channels_last:
        stage = stage.to(memory_format=torch.channels_last)
    optimizer = torch.optim.Adam([p for p in stage.parameters() if p.requires_grad], 1e-6, fused=True)
    marks: list[float] = []

    def now() -> float:
        if device.type == "cuda":
            torch.cuda.synchronize()
        return time.perf_counter()

    for net in (stage.depth_net, stage.pose_net):
        net.register_forward_pre_hook(lambda *_: marks.append(-now()))
        net.register_forward_hook(lambda *_: marks.append(now()))
    rows = []
    for _ in range(2 + repeats):
        marks.clear()
        began = now()
        with torch.autocast(device.type, torch.bfloat16, enabled=training.precision == "bf16"):
            output = stage(batch)
        forward = now()
        optimizer.zero_grad()
        output.losses.total.backward()
        backward = now()
        optimizer.step()
        done = now()
        parts = {"networks": sum(marks), "losses": forward - began - sum(marks)}
        rows.append(parts | {"backward": backward - forward, "optimiser": done - backward, "step": done - began})
    peak = torch.cuda.max_memory_allocated() if device.type == "cuda" else peak_of_process()
    return {**pd.DataFrame(rows[2:]).to_dict("list"), "peak_mb": [peak / 1e6]}


def peak_of_process() -> int:
    """Most bytes that this process held; what `getrusage` says begins with its parent's."""
    status = Path("/proc/self/status")
    if status.exists():
        return 1024 * int(status.read_text().partition("VmHWM:")[2].split()[0])
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def in_turns(works: dict[str, Callable[[], object]], device: torch.device, repeats: int) -> dict[str, list[float]]:
    """Seconds of each work, one after the other, so many times, after two that do not count."""
    seconds: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(2 + repeats):
        for name, work in works.items():
            began = time.perf_counter()
            work()
            if device.type == "cuda":
                torch.cuda.synchronize()
            seconds[name].append(time.perf_counter() - began)
    return {name: values[2:] for name, values in seconds.items()}


def step_of(net: nn.Module, loss: Callable[[], torch.Tensor], device: torch.device, precision: Precision) -> Callable[[], object]:
    """A training step: what the loss is of, backward, optimiser."""
    optimizer = torch.optim.Adam(net.parameters(), 1e-6, fused=True)

    def step() -> None:
        with torch.autocast(device.type, torch.bfloat16, enabled=precision == "bf16"):
            total = loss()
        optimizer.zero_grad()
        total.backward()
        optimizer.step()

    return step


def beside_a_peer(training: Training, batch: dict[str, Any], device: torch.device, repeats: int) -> dict[str, list[float]]:
    """Seconds of a step of stage 1, as the paper has it (`ours`) and without its feature loss (`plain`), which sends three views through
    LR-Net instead of one, and of monodepth2's (`peer`) at LR-Net's size, all with ResNet18, in turns."""
    images, matrix = low_resolution(to_unit(batch["images"])), resize_intrinsics(batch["intrinsics"], 1 / 3, 1 / 3)
    losses_of = {
        name: training.loss.model_copy(update={"feature": weight}) for name, weight in {"ours": Loss().feature, "plain": 0}.items()
    }
    settings = {name: training.model_copy(update={"loss": loss}) for name, loss in losses_of.items()}
    stages = {name: Stage(LRNet("resnet18"), PoseNet(), each, low=True) for name, each in settings.items()}
    nets = {name: net.to(device, memory_format=torch.channels_last).train() for name, net in {**stages, "peer": Peer()}.items()}
    losses = {name: (net, lambda net=net: net(batch).losses.total) for name, net in nets.items()}
    losses["peer"] = (nets["peer"], lambda: nets["peer"](images, matrix))
    return in_turns({name: step_of(net, loss, device, training.precision) for name, (net, loss) in losses.items()}, device, repeats)


def inference_parts(net: DualNet, image: torch.Tensor, precision: Precision, repeats: int) -> dict[str, list[float]]:
    """Seconds of the parts of the dual network's inference, each time: LR-Net's encoder, SA-Attention, HR-Net, and the whole."""
    marks: dict[str, float] = {}

    def clock(sign: int, name: str) -> Callable[..., None]:
        def mark(*_: object) -> None:
            if image.is_cuda:
                torch.cuda.synchronize()
            marks[name] = marks.get(name, 0.0) + sign * time.perf_counter()

        return mark

    parts = {"LR-Net's encoder": net.lr_net.encoder, "SA-Attention": net.attention, "HR-Net": net.hr_net, "whole": net}
    hooks = [part.register_forward_pre_hook(clock(-1, name)) for name, part in parts.items()]
    hooks += [part.register_forward_hook(clock(1, name)) for name, part in parts.items()]
    rows = []
    with torch.inference_mode(), torch.autocast(image.device.type, torch.bfloat16, enabled=precision == "bf16"):
        for _ in range(2 + repeats):
            marks.clear()
            net(image, scales=1)
            rows.append({name: marks[name] for name in parts})
    for hook in hooks:
        hook.remove()
    return pd.DataFrame(rows[2:]).to_dict("list")


def machine(device: torch.device, precision: Precision) -> tuple[float, float]:
    """What the machine can do at most: multiply-accumulates a second of a large matrix product, bytes a second of a copy, both ways."""
    dtype = torch.bfloat16 if precision == "bf16" else torch.float32
    a, b, large = (torch.ones(n, m, dtype=dtype, device=device) for n, m in ((2048, 2048), (2048, 2048), (8192, 8192)))
    other = torch.empty_like(large)

    def seconds(work: Callable[[], object]) -> float:
        def run() -> None:
            work()
            if device.type == "cuda":
                torch.cuda.synchronize()

        run()
        return min(timeit.repeat(run, number=1, repeat=7))

    return 2048**3 / seconds(lambda: a @ b), 2 * large.nbytes / seconds(lambda: other.copy_(large))


def floors(name: str, training: Training, batch: dict[str, Any], device: torch.device, precision: Precision) -> dict[str, float]:
    """Seconds below which the parts of a step cannot come: by its networks' multiply-accumulates, of which what learns needs twice as many
    for gradients, and, of the losses, by reading images and disparities of all scales once, in float32."""
    images = to_unit(batch["images"].cpu())
    small, (size, _, _, height, width) = low_resolution(images), images.shape
    net = LRNet(training.encoder) if name == "lr" else make_net(name, training.encoder)
    seen = (small if name == "lr" else images)[:1, 0]
    both = count(net, seen).macs, count(PoseNet(), small[:1]).macs
    frozen = count(net.lr_net.encoder, small[:1, 0]).macs if name == "dual" else 0
    macs, (peak, bandwidth) = size * sum(both), machine(device, precision)
    pixels = size * height * width / (9 if name == "lr" else 1) * sum(0.25**scale for scale in range(training.loss.scales))
    return {
        "networks": macs / peak,
        "losses": pixels * (9 + 1) * 4 / bandwidth,
        "backward": 2 * (macs - size * frozen) / peak,
        "optimiser": 7 * 4 * sum(p.numel() for p in net.parameters() if p.requires_grad) / bandwidth,  # weight, gradient, two moments
    }


def parts_of(name: str, step: dict[str, list[float]], floor: dict[str, float]) -> Iterator[tuple[str, list[float], str]]:
    """The parts of a step in seconds, each with its floor."""
    for part in ("networks", "losses", "backward", "optimiser"):
        yield f"  {name}: {part}", step[part], "s"
        yield f"  {name}: {part}, floor", [floor[part]], "s"


def ratios(a: list[float], b: list[float]) -> list[float]:
    """Of what was measured in turns."""
    return [x / y for x, y in zip(a, b)]


def measurements(profile: Profile, encoder: str, repeats: int) -> Iterator[tuple[str, list[float], str]]:
    """All measurements, each as soon as it is made: what, value each time, unit."""
    device, (height, width) = default_device(), profile.data.hr_size
    precisions: list[Precision] = ["bf16", "float32"] if has_bf16(device) else ["float32"]
    training = profile.training.model_copy(update={"encoder": encoder, "precision": precisions[0]})
    low, high = f"{height // 3}x{width // 3}", f"{height}x{width}"
    with tempfile.TemporaryDirectory() as folder:
        dataset = TripletDataset([write_frames(Path(folder))], profile.data.hr_size, training.augmentation, 0)
        cv2.setNumThreads(1)
        load = timeit.repeat(lambda: dataset[0, 0], number=1, repeat=10 * repeats + 1)[1:]
        cv2.setNumThreads(-1)
        batch = default_collate([dataset[epoch, 0] for epoch in range(4)])
    yield f"loader, one core: JPEG 1242x375 to HR tensors {high}", [1 / seconds for seconds in load], "triplets/s"

    batch = {k: v.to(device) if torch.is_tensor(v) else v for k, v in batch.items()}
    steps = {p: timed_steps("lr", training.model_copy(update={"precision": p}), batch, device, repeats) for p in precisions}
    step = steps[training.precision]
    yield f"stage 1 step, {encoder} {low}, batch 4, {training.precision}", step["step"], "s"
    yield from parts_of("stage 1", step, floors("lr", training, batch, device, training.precision))
    if "bf16" in steps:
        yield "  float32 step / bf16 step", [statistics.median(steps["float32"]["step"]) / statistics.median(step["step"])], "ratio"
    yield "  loading a batch on one core / step", [statistics.median(load) * 4 / statistics.median(step["step"])], "ratio"
    for precision in precisions:
        beside = beside_a_peer(training.model_copy(update={"precision": precision}), batch, device, repeats)
        yield f"monodepth2's step, resnet18 {low}, batch 4, {precision}", beside["peer"], "s"
        for name, what in {"ours": "", "plain": ", without feature loss"}.items():
            yield f"  stage 1 step with resnet18{what} / monodepth2's, {precision}, in turns", ratios(beside[name], beside["peer"]), "ratio"

    # stage 2 against a ResNet18 network with the same decoder; a process for each, since its peak of memory is measured
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn"), max_tasks_per_child=1) as pool:
        inside = training.model_copy(update={"encoder": profile.training.encoder})  # of the dual network
        arguments = (inside, batch, device, repeats)
        for _ in range(2):  # the first process of that size finds memory in small pieces, and is slower: the second of each counts
            large = {name: pool.submit(timed_steps, name, *arguments).result() for name in ("dual", "resnet18")}
    for name, step in large.items():
        yield f"stage 2 step, {name} {high}, batch 4, {training.precision}", step["step"], "s"
        yield "  peak memory", step["peak_mb"], "MB"
        yield from parts_of(name, step, floors(name, inside, batch, device, training.precision))
    for part in ("step", "peak_mb"):
        yield f"  dual / resnet18, {part}", [statistics.median(large["dual"][part]) / statistics.median(large["resnet18"][part])], "ratio"

    # one image; LR-Net's decoder, which depth at high resolution does not need, is not run
    image = to_unit(batch["images"][:1, 0])
    nets = {
        name: let_see(make_net(name, profile.training.encoder), image.cpu()).to(device, memory_format=torch.channels_last)
        for name in ("dual", "resnet18")
    }
    for precision in precisions:
        works = {name: lambda net=net, p=precision: infer(net, image, p) for name, net in nets.items()}
        seconds = in_turns(works, device, repeats)
        for name, values in seconds.items():
            yield f"inference, {name} {high}, {precision}", values, "s"
        yield "  dual / resnet18, in turns", ratios(seconds["dual"], seconds["resnet18"]), "ratio"
    for part, values in inference_parts(nets["dual"].eval(), image, precisions[0], repeats).items():
        yield f"  dual, {precisions[0]}: {part}", values, "s"


@torch.inference_mode()
def infer(net: nn.Module, image: torch.Tensor, precision: Precision) -> None:
    """Depth of one image."""
    with torch.autocast(image.device.type, torch.bfloat16, enabled=precision == "bf16"):
        net.eval()(image, scales=1)


def main(argv: list[str] | None = None) -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description="Measure loader, training step and inference, beside a peer.")
    parser.add_argument("--profile", default="paper", help="whose sizes (default: %(default)s)")
    parser.add_argument("--encoder", default="resnet18", help="LR-Net's encoder (default: %(default)s)")
    parser.add_argument("--repeats", type=int, default=5, help="counted runs of each step (default: %(default)s)")
    parser.add_argument("--out", default="results/bench.csv", metavar="FILE", help="(default: %(default)s)")
    arguments = parser.parse_args(argv)
    rows = []
    for what, values, unit in measurements(load_profile(arguments.profile), arguments.encoder, arguments.repeats):
        rows.append((what, statistics.median(values), min(values), max(values), len(values), unit))
        spread = f" ({min(values):.3g} to {max(values):.3g})" if len(values) > 1 else ""
        print(f"{what}: {rows[-1][1]:.3g}{spread} {unit}", flush=True)
    table = pd.DataFrame(rows, columns=["what", "median", "lowest", "highest", "n", "unit"]).assign(device=device_name())
    write_text(arguments.out, table.to_csv(index=False, float_format="%.4g"))
    print(f"written to {arguments.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
