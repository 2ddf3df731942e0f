"""Tables of results/ on what policies achieve: pretraining, deployment, the benchmark, the closed loop."""

from collections.abc import Callable
from statistics import median

from tools.tables import RESULTS, Row, curves, digits, minutes, percent, pick, read, table, tenth

TASKS = ("hammer", "insert", "push_towel", "push_ball", "rope_peg_in_hole")
ROUNDED = ("episodes", "success", "low", "high")
NAMED = {"gap": "gap", "seed": "seed", "effect": "effect", "parameter": "parameter"}
NAMED |= {name: (name, digits) for name in ("value", "low", "high")}


def pretrain() -> str:
    head = {
        "seed": "seed",
        "episodes": "episodes_evaluated",
        "success": ("success", tenth),
        "low": ("success_low", tenth),
    }
    head |= {"high": ("success_high", tenth), "prior": ("prior_success", percent), "minutes": ("wall_seconds", minutes)}
    parts = [
        f"{name}\n\n{pick(read(f'pretrain/{file}.csv'), head)}"
        for name, file in (("From scratch:", "pretrain"), ("The second stage (`+experiment=polish`):", "polish"))
    ]
    rounded = {"model": "model", "updates in": "precision"} | {k: v for k, v in head.items() if k in ROUNDED}
    parts += ["A wide model:", pick(read("pretrain/precision.csv"), rounded | {"return": "return"})]
    own = {k: v for k, v in head.items() if k != "minutes"} | {"learner's memory [MB]": "learner_mb"}
    parts += ["Collected on a Ray cluster:", pick(read("pretrain/ray.csv"), own)]
    spent = {name: head[name] for name in (*ROUNDED, "prior")}
    spent |= {f"{part} [s]": f"{part}_seconds" for part in ("update", "evaluate", "wait", "save")}
    spent |= {"learner [MB]": "learner_mb", "collector [MB]": "collector_mb"}
    return "\n\n".join(
        [*parts, "Seed 0 by later code, where its seconds go, and its memory:", pick(read("pretrain/parts.csv"), spent)]
    )


def transfer() -> str:
    rows = read("transfer/sgft.csv") + read("transfer/tdmpc2.csv")
    return curves(rows, method_in_gap, "gap and method")


def tasks() -> str:
    head: dict[str, str | tuple[str, Callable[[str], str]]] = {
        "task": "task",
        "transitions": "transitions",
        "minutes": "minutes",
        "planner's success": ("success", percent),
        "return": "return",
        "episodes": "episodes",
    }
    files = [f"tasks/{name}{method}.csv" for name in TASKS for method in ("", "_tdmpc2")]
    rows = [row for file in files if (RESULTS / file).exists() for row in read(file)]
    parts = [pick(read("tasks/pretrained.csv"), head), curves(rows, method_in_gap, "gap and method")]
    kept = [{**row, "task": name} for name in ("hammer", "insert") for row in read(f"tasks/{name}_mild.csv")]
    parts.append(f"In `mild`, where there is nothing to gain:\n\n{curves(kept, lambda row: row['task'], 'task')}")
    today = curves(read("tasks/mild.csv"), lambda row: row["task"], "task")
    parts.append(f"With two command maps:\n\n{today}")
    walked: dict[str, str | tuple[str, Callable[[str], str]]]
    walked = {"gap": "gap", "method": "method", "seed": "seed", "rollouts": "rollouts"}
    walked |= {"return": ("return", digits), "success": ("success", percent)}
    parts.append(f"Return, of at most 200:\n\n{pick(read('tasks/walker_walk.csv'), walked)}")
    bound = {name: name for name in ("checkpoint", "transitions", "episodes")} | {"return": ("return", digits)}
    parts.append(f"What training in `walker_real` itself comes to:\n\n{pick(read('tasks/walker_bound.csv'), bound)}")
    named = pick(read("tasks/diagnose_run.csv"), {**NAMED, "verdict": "verdict"})
    parts.append(f"What `diagnose --run` names in these realities:\n\n{named}")
    return "\n\n".join(parts)


def once() -> str:
    now, before = (
        curves(read(f"once/{name}.csv"), method_in_gap, "gap and method") for name in ("once", "once_before")
    )
    return f"{now}\n\nBefore `method.win_stay`:\n\n{before}"


def benchmark() -> str:
    """Who is how good after so many rollouts, in each gap and in all, and who is probably better than whom."""
    rows = read("benchmark/scores.csv")
    gaps = list(dict.fromkeys(row["gap"] for row in rows))
    parts = []
    for count in dict.fromkeys(row["rollouts"] for row in rows):
        mine = {(r["method"], r["gap"]): r for r in rows if r["rollouts"] == count}
        lines = [
            [f"`{m}`", *(mean_of(mine[m, g]) if (m, g) in mine else "" for g in gaps)]
            for m in dict.fromkeys(method for method, _ in mine)
        ]
        heads = [gap if gap == "all" else f"`{gap}`" for gap in gaps]
        parts.append(f"After {count} rollouts:\n\n{table(['method', *heads], lines)}")
    better = [row for row in read("benchmark/better.csv") if row["method"] == "sgft"]
    counts = list(dict.fromkeys(row["rollouts"] for row in better))
    by = {(row["over"], row["rollouts"]): row for row in better}
    lines = [
        [f"`{other}`", *(probable(by[other, n]) if (other, n) in by else "" for n in counts)]
        for other in dict.fromkeys(row["over"] for row in better)
    ]
    heads = [f"after {n} rollouts" for n in counts]
    parts.append(f"How probable it is that a run of `sgft` ends above one of\n\n{table(['', *heads], lines)}")
    runs = [row for row in read("benchmark/runs.csv") if row["seconds"] and row["updates"]]
    cost = []
    for method in dict.fromkeys(row["method"] for row in runs):
        own = [row for row in runs if row["method"] == method]
        seconds, updates = (median(float(row[name]) for row in own) for name in ("seconds", "updates"))
        cost.append([f"`{method}`", own[0]["rollouts"], f"{updates:.0f}", f"{seconds:.0f}"])
    head = ["method", "real rollouts", "updates", "seconds, median"]
    parts += ["What a run costs:", table(head, cost)]
    roped = curves(read("benchmark/rope.csv"), lambda row: f"`{row['method']}`", "method")
    parts.append(f"In `rope_real`:\n\n{roped}")
    alone = {"method": "method", "gap": "gap", "seed": "seed", "in its simulation": ("sim_success", percent)}
    alone |= {"success": ("success", percent), "low": ("low", percent), "high": ("high", percent)}
    parts.append(f"Policies that simulation alone has trained:\n\n{pick(read('benchmark/zero_shot.csv'), alone)}")
    return "\n\n".join(parts)


def mean_of(row: Row) -> str:
    return f"{percent(row['iqm'])} [{percent(row['low'])}, {percent(row['high'])}], {row['runs']}"


def probable(row: Row) -> str:
    return f"{percent(row['probability'])} [{percent(row['low'])}, {percent(row['high'])}]"


def method_in_gap(row: Row) -> str:
    return f"`{row['gap']}`, {row['method']}"


def outside() -> str:
    def way(row: Row) -> str:
        return f"`{row['gap']}`, {'one map, with a dead band' if row['variant'] else 'one map, without'}"

    today = curves([*read("outside/deadband.csv"), *read("outside/offset.csv")], method_in_gap, "gap and method")
    earlier = curves(read("outside/band.csv"), way, "gap, command map")
    first = curves(read("outside/sgft.csv"), method_in_gap, "gap and method")
    told = curves(read("outside/failed_only.csv"), method_in_gap, "gap and method")
    again = curves(read("outside/again.csv"), method_in_gap, "gap and method")
    parts = [first, "By later settings, before `method.win_stay`:", again]
    parts += ["With two command maps, `offset` with suspicions too:", today]
    parts += ["Suspicions told by rollouts that failed alone:", told, "What led there:", earlier]
    return "\n\n".join(parts)


def audit() -> str:
    (found,) = read("audit/auc.csv")
    area = f"{percent(found['auc'])} [{percent(found['low'])}, {percent(found['high'])}]"
    runs = pick(
        read("audit/runs.csv"),
        {"gap": "gap", "seed": "seed", "improvable": ("share", percent), "best success": ("best", percent)},
    )
    head = ["area under the curve", "runs", "of gaps", "reached 90 %"]
    return table(head, [[area, found["runs"], found["gaps"], found["reached"]]]) + "\n\n" + runs


def healthy() -> str:
    """Return of each implementation, median and range over its seeds."""
    rows = read("healthy/healthy.csv")
    lines = []
    for method, ours in dict.fromkeys((row["method"], row["implementation"]) for row in rows):
        own = [row for row in rows if (row["method"], row["implementation"]) == (method, ours)]
        returns, steps = [float(row["return"]) for row in own], own[0]["steps"]
        cell = f"{median(returns):.0f} ({min(returns):.0f} to {max(returns):.0f})"
        lines.append([f"`{method}`", ours, steps, own[0]["updates"], len(own), cell])
    return table(["method", "implementation", "steps", "updates", "seeds", "return"], lines)


def critic() -> str:
    head = {"critic": "critic", "puck at x [m]": "puck_x_m", "V": "value", "return": "return"}
    puck = pick(read("critic_profile/critic_profile.csv"), head)
    rows = read("critic_profile/rope.csv")
    aside = list(dict.fromkeys(row["hand_aside_m"] for row in rows))
    heights = dict.fromkeys(row["hand_above_m"] for row in rows)
    lines = [[above, *(row["value"] for row in rows if row["hand_above_m"] == above)] for above in heights]
    peg = table(["V, hand over the table [m]", *(f"{x} m across" for x in aside)], lines)
    return f"{puck}\n\nA peg beside the hole, the hand over it or across the hole:\n\n{peg}"


def exact() -> str:
    head = {"gap": "gap", "H": "horizon", "reward": "reward", "episodes": "episodes", "success": ("success", percent)}
    return pick(read("exact_dynamics/exact_dynamics.csv"), head)


def loop() -> str:
    head = {
        "gap": "gap",
        "seed": "seed",
        "zero-shot": ("zero_shot_before", percent),
        "after": ("zero_shot_after", percent),
    }
    head |= {"30 rollouts": ("final_before", percent), "after ": ("final_after", percent)}
    head |= {"rollouts to 95 %": "rollouts_to_95_before", "after  ": "rollouts_to_95_after"}
    parts = [pick(read("close_the_loop/close_the_loop.csv"), head)]
    alone = {"gap": "gap", "seed": "seed", "found": "found"} | {k: head[k] for k in ("zero-shot", "after")}
    for file, says in (
        ("identify", "Identification alone"),
        ("identify_again", "The same again, by the present solver"),
    ):
        identified = pick(read(f"close_the_loop/{file}.csv"), {"verdict": "verdict"} | alone)
        parts.append(f"{says}, from ten rollouts of the policy that fails:\n\n{identified}")
    ranges = pick(read("close_the_loop/dropo.csv"), alone)
    parts.append(f"Ranges of the randomisation in place of names (DROPO):\n\n{ranges}")
    for file, says in (
        ("diagnose_run", "What was named"),
        ("diagnose_run_again", "Of others, with the present solver"),
    ):
        parts.append(f"{says}:\n\n{pick(read(f'close_the_loop/{file}.csv'), NAMED)}")
    return "\n\n".join(parts)
