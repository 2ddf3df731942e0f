"""Freed memory stays in the process, where the C library can be told so."""

import subprocess
import sys
from pathlib import Path

import pytest

FAULTS = """
import resource, torch
from planners.malloc import keep_freed_memory
torch.set_num_threads(1)

def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(10):
        x = [torch.zeros(5_000_000) for _ in range(4)]  # 20 MB each, written to
        del x
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

faults()
default = faults()
assert keep_freed_memory()
faults()
print(default, faults())
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs Linux")
def test_memory_is_not_fetched_again() -> None:
    root = Path(__file__).resolve().parents[2]
    run = subprocess.run(
        [sys.executable, "-c", FAULTS], cwd=root, capture_output=True, text=True, timeout=120, check=True
    )
    default, kept = map(int, run.stdout.split())
    assert kept < 0.1 * default or default == kept == 0  # some C libraries keep freed memory by themselves
