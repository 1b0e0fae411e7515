"""The networks: LR-Net and its encoders, HR-Net, SA-Attention, PoseNet. They know nothing of data or training."""

from typing import Literal

Network = Literal["lr", "single", "dual", "hr"]
Link = Literal["attention", "embedding", "direct"]
Similarity = Literal["dot", "cosine", "l1", "l2"]
Normalise = Literal["none", "mean", "softmax"]
PoseEncoder = Literal["efficientnet_lite0", "mobilenet_v2", "resnet18", "resnet50"]
