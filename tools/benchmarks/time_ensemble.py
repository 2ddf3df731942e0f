"""Critics one after the other beside critics whose layers are one batched product.

    python -m tools.benchmarks.time_ensemble [--sizes small 1M 5M] [--members 2 5] [--out CSV]

One thread; forward and backward of a loss over 768 rows (256 slices of three steps) in float32. `batched` is all first
layers as one product, for they share their input, and each later layer as one `baddbmm`. Both are timed in turn;
`to_loop` is the ratio of their best times.
"""

import argparse
import sys
from pathlib import Path

import torch
import torch.nn.functional as F
from omegaconf import OmegaConf
from torch import Tensor, nn

from mpc_sgft.learning.layers import Ensemble, mish, mlp
from planners.malloc import keep_freed_memory
from tools.benchmarks.time_planner import ROOT, UPSTREAM, cpu_name, seconds
from tools.studies.runner import write

COLUMNS = "size members loop_ms batched_ms to_loop cpu".split()
ROWS, REPEATS = 768, 20


class Batched(nn.Module):
    """The members of an ensemble of perceptrons with two hidden layers, each layer as one product."""

    def __init__(self, ensemble: Ensemble) -> None:
        super().__init__()
        linear = [[layer.linear for layer in member[:-1]] + [member[-1]] for member in ensemble]  # type: ignore
        norms = [[layer.norm for layer in member[:-1]] for member in ensemble]  # type: ignore
        self.linear, self.norms = self._stacked(linear), self._stacked(norms)

    def _stacked(self, layers: list[list[nn.Module]]) -> nn.ModuleList:
        """Weights [E, m, n] and biases [E, 1, m] of each layer."""
        out = nn.ModuleList()
        for same in zip(*layers, strict=True):
            weight, bias = (torch.stack([getattr(x, name).detach() for x in same]) for name in ("weight", "bias"))
            out.append(nn.ParameterDict({"weight": weight, "bias": bias.unsqueeze(1)}))
        return out

    def forward(self, x: Tensor) -> Tensor:
        """Rows [N, n] through every member: [E, N, bins]."""
        members, width = self.linear[0]["weight"].shape[:2]
        wide = F.linear(x, self.linear[0]["weight"].flatten(0, 1), self.linear[0]["bias"].flatten())
        hidden = wide.view(-1, members, width).transpose(0, 1)
        for norm, layer in zip(self.norms, self.linear[1:], strict=True):
            normed = F.layer_norm(hidden, (width,))
            hidden = mish(torch.addcmul(norm["bias"], normed, norm["weight"].unsqueeze(1)))
            hidden = torch.baddbmm(layer["bias"], hidden, layer["weight"].transpose(1, 2))
        return hidden


def measure(size: str, members: int) -> dict[str, object]:
    model = OmegaConf.load(ROOT / f"configs/model/{size}.yaml")
    inputs, hidden = model.latent_dim + UPSTREAM[1], model.mlp_dim
    loop = Ensemble([mlp([inputs, hidden, hidden, model.num_bins]) for _ in range(members)])
    x, best = torch.randn(ROWS, inputs), [float("inf")] * 2
    ways = (loop, Batched(loop))

    def step(way: nn.Module) -> None:
        way.zero_grad()
        way(x).square().mean().backward()

    for _ in range(REPEATS):
        for i, way in enumerate(ways):
            best[i] = min(best[i], min(seconds(lambda way=way: step(way), 2)[0]))
    row: dict[str, object] = {"size": size, "members": members}
    row |= {"loop_ms": round(1e3 * best[0], 2), "batched_ms": round(1e3 * best[1], 2)}
    return row | {"to_loop": round(best[1] / best[0], 2), "cpu": cpu_name()}


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", nargs="+", default=["small", "1M", "5M"])
    parser.add_argument("--members", nargs="+", type=int, default=[2, 5])
    parser.add_argument("--out", type=Path, default=ROOT / "results/timing/time_ensemble.csv")
    args = parser.parse_args(arguments)
    keep_freed_memory()
    torch.set_num_threads(1)
    rows = [measure(size, members) for size in args.sizes for members in args.members]
    write(args.out, COLUMNS, rows)
    print(f"written to {args.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
