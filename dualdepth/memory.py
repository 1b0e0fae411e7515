"""The C library's memory allocator, told to keep what a training frees."""

import ctypes

M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_MAX = -1, -2, -4
"""Names and numbers of glibc's `malloc.h`."""
PAD = 1 << 26
"""Bytes that the heap grows by at least."""


def keep_freed_memory() -> bool:
    """Keep freed memory in this process, for tensors on the CPU.

    glibc gives every large tensor back to the system when it is freed, and the next one of that size is paged in and zeroed anew: a third
    of a training step at high resolution, for some more memory in use. Numbers do not change.

    Returns:
        Whether the allocator is glibc's and took it.
    """
    try:
        mallopt = ctypes.CDLL("libc.so.6").mallopt
    except (OSError, AttributeError):
        return False
    return all([mallopt(M_MMAP_MAX, 0), mallopt(M_TRIM_THRESHOLD, -1), mallopt(M_TOP_PAD, PAD)])
