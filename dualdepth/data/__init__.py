"""Readers and preparation of KITTI's formats."""
