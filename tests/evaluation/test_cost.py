"""Parameters, multiply-accumulates, time and memory of small networks known by hand."""

import pytest
import torch
from torch import nn

from dualdepth.evaluation.cost import count, latency


def test_strides_groups_linear_layers_and_products_count_by_hand():
    class Net(nn.Module):
        def __init__(self):
            super().__init__()
            self.strided = nn.Conv2d(4, 6, 5, stride=2, padding=2)
            self.depthwise = nn.Conv2d(6, 6, 3, padding=1, groups=6, bias=False)
            self.norm = nn.BatchNorm2d(6)
            self.head = nn.Linear(6, 7)

        def forward(self, image):
            f = self.norm(self.depthwise(self.strided(image))).flatten(2)  # (1, 6, 16)
            return self.head((f @ (f.transpose(1, 2) @ f)).mean(-1))

    macs = 6 * 4 * 25 * 16 + 6 * 9 * 16 + 2 * 6 * 16 * 16 + 6 * 7
    params = 6 * 4 * 25 + 6 + 6 * 9 + 12 + 49
    assert count(Net(), torch.zeros(1, 4, 8, 8)) == (params, macs)


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU"))])
def test_latency_reports_time_and_the_memory_of_weights_input_and_activations(device):
    net = nn.Sequential(nn.ReLU(), nn.ReLU(), nn.ReLU(), nn.Flatten(), nn.Linear(4_000, 10)).to(device).train()
    image = torch.zeros(50, 4, 1_000, device=device)
    measured = latency(net, image, repeats=3)
    held = 4 * (40_000 + 10 + 200_000)
    # the second ReLU has its input and its output beside the image
    assert measured.peak_mb == pytest.approx((held + 2 * 4 * 200_000) / 1e6, rel=0.02)
    assert 0 < measured.median_ms < 1000
    assert not net.training
