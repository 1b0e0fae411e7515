"""A network small enough for tests."""

from pathlib import Path


def save_encoder(folder: str | Path, deepest: int = 64) -> str:
    """Write the configuration of a ResNet of some ten thousand weights; gives the folder, for a profile's `encoder`.

    Its maps have at least 16 channels: the CPU's backward of a narrower 1×1 convolution of stride 2 in channels-last order crashes.
    """
    from transformers import ResNetConfig

    widths = [16, 32, 48, deepest]
    ResNetConfig(hidden_sizes=widths, depths=[1, 1, 1, 1], embedding_size=16, layer_type="basic").save_pretrained(folder)
    return str(folder)
