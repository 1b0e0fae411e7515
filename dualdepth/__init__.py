"""dualdepth: a replication of "Unsupervised High-Resolution Depth Learning From Videos With Dual Networks" (ICCV 2019)."""

__version__ = "0.1.0"
