"""Keep freed memory in the process: a planner asks for the same few megabytes thousands of times a second."""

import ctypes
import sys

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # malloc.h
LARGEST_KEPT = 32 * 1024 * 1024  # bytes; glibc allows no more


def keep_freed_memory() -> bool:
    """Tell glibc's malloc not to hand freed memory back to the operating system; call once, at the start of a program.

    By default every large intermediate tensor is returned and fetched again page by page, which costs a plan 10-25 % of
    its time on a CPU (tools/benchmarks/time_planner.py --default-malloc). The process then keeps its peak size.

    Returns:
        Whether it worked; False where the C library is another one, and nothing has changed then.
    """
    if not sys.platform.startswith("linux"):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    return bool(mallopt(M_MMAP_THRESHOLD, LARGEST_KEPT)) and bool(mallopt(M_TRIM_THRESHOLD, 2**31 - 1))
