"""The bench times the parts of a training step."""

import pytest
import torch

from dualdepth.profile import load_profile
from tools.bench import median_step


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lr", "dual"])
def test_a_step_is_timed_by_its_parts(name, encoder):
    training = load_profile("tiny").training.model_copy(update={"encoder": encoder})
    images = torch.randint(0, 255, (1, 3, 3, 192, 192), dtype=torch.uint8)
    matrix = torch.tensor([[[200.0, 0, 96], [0, 200, 96], [0, 0, 1]]])
    found = median_step(name, training, {"images": images, "intrinsics": matrix}, torch.device("cpu"), 1)
    parts = [found.pop(part) for part in ("networks", "losses", "backward", "optimiser")]
    assert min(parts) > 0 and sum(parts) == pytest.approx(found["step"]) and found["peak_mb"] > 100
