"""A network small enough for tests."""

from pathlib import Path


def save_encoder(folder: str | Path) -> str:
    """Write the configuration of a ResNet of some ten thousand weights; gives the folder, for a profile's `encoder`.

    Its maps have at least 16 channels: the CPU's backward of a narrower 1×1 convolution of stride 2 in channels-last order crashes.
    """
    from transformers import ResNetConfig

    ResNetConfig(hidden_sizes=[16, 32, 48, 64], depths=[1, 1, 1, 1], embedding_size=16, layer_type="basic").save_pretrained(folder)
    return str(folder)
