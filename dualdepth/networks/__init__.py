"""The networks: LR-Net and its encoders, HR-Net, SA-Attention, PoseNet. They know nothing of data or training."""
