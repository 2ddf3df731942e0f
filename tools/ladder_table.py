"""The table of results/ladder: what each of our additions buys, from SGFT as published up."""

from collections.abc import Sequence

from tools.tables import Row, read, spread, table

ADDITIONS = {  # of ours, by the setting that turns one off; settings that are on together with others have no line
    "method.command_map": "command map",
    "method.command_sparsity": "few causes",
    "method.observation_map": "observation map",
    "method.anchor": "anchor",
    "method.gate": "gate",
    "method.average_decay": "average",
    "method.policy_share": "prior held back",
    "method.lr_decay": "falling rates",
    "method.entropy_coef": "broad prior",
    "planner.num_elites": "many elites",
}
LATER = {"method.win_stay": "win-stay", "planner.neutral": "neutral action"}  # rows of before were all without


def rung(row: Row) -> str:
    """What a run of the ladder has of our additions."""
    words = [change.split("=")[0] for change in row["variant"].split()]
    if row["method"] == "sgft_paper":
        frozen = " and ".join(word.removeprefix("method.") for word in words if word != "method.lr")
        rate = " at TD-MPC2's rate" if "method.lr" in words else ""
        return f"`sgft_paper`{rate}, {frozen} frozen" if frozen else f"`sgft_paper`{rate}, as published"
    every = ADDITIONS | LATER
    named = [every[word] for word in words if word in every]
    if row["method"] == "tdmpc2":
        rate = " at pretraining's rate" if "method.lr" in words else ""
        rate += " and plans that end in Q" if "method.terminal" in words else ""
        return f"`tdmpc2`{rate} with {', '.join(named)}" if named else f"`tdmpc2`{rate}, plain"
    if not named:
        return "`sgft`, all of ours then"
    if len(named) <= 2:
        return f"all but {', '.join(named)}"
    kept = [what for what in ADDITIONS.values() if what not in named and what != "few causes"]
    return f"{', '.join(kept)} alone" if kept else "the objective alone"


def ladder() -> str:
    """Success in each gap after the rollouts, a line for each set of additions."""
    rows = [row for name in ("sgft_paper", "sgft", "tdmpc2") for row in read(f"ladder/{name}.csv")]
    gaps = list(dict.fromkeys(row["gap"] for row in rows))
    last = str(max(int(row["rollouts"]) for row in rows))
    lines = []
    for name in dict.fromkeys(map(rung, rows)):
        mine = [row for row in rows if rung(row) == name and row["rollouts"] == last]
        cells = [[float(r["success"]) for r in mine if r["gap"] == gap] for gap in gaps]
        lines.append([name, *map(of_seeds, cells)])
    return table(["additions", *(f"`{gap}`" for gap in gaps)], lines)


def of_seeds(values: Sequence[float]) -> str:
    """Median and range of a cell, and of how many seeds; empty where nothing was run."""
    return f"{spread(values)}, {len(values)} seed{'s' * (len(values) > 1)}" if values else ""
