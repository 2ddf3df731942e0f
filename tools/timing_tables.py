"""Tables of results/ on what computing costs: plans, updates, environments, workers."""

from collections.abc import Callable

from tools.tables import percent, pick, read, table, tenth


def timing() -> str:
    plan = {name: name for name in ("what", "size", "precision", "horizon", "decay", "rows", "threads")}
    plan = {**plan, "median ms": "median_ms", "share of peak": "share_of_peak", "to upstream": "ratio_to_upstream"}
    diagnose = {"what": "what", "s of data": "seconds_of_data", "names": "names", "wall s": "wall_s", "per unit": "per"}
    env = {"task": "task", "what": "what", "physics steps / s": "physics_steps_per_s"}
    env |= {"control steps / s": "control_steps_per_s", "ControlEnv / this": "control_env_over_this"}
    pairs = (("time_planner", plan), ("time_diagnose", diagnose), ("benchmark_env", env))
    parts = [pick(read(f"timing/{file}.csv"), columns) for file, columns in pairs]
    like = [row for row in read("timing/time_planner_like.csv") if row["ratio_to_upstream"]]
    parts[1:1] = ["On cores like upstream's:", pick(like, plan)]
    floor = {"what": "what", "size": "size", "precision": "precision", "GFLOP": "gflop", "GB": "gbyte"}
    floor |= {"peak GFLOP/s": "peak_gflops", "peak GB/s": "peak_gbyte", "least ms": "floor_ms", "best ms": "best_ms"}
    least = pick(read("timing/roofline.csv"), floor)
    ways = {"size": "size", "critics": "members", "one by one [ms]": "loop_ms", "as one product [ms]": "batched_ms"}
    critics = pick(read("timing/time_ensemble.csv"), ways)
    parts += ["The least time that arithmetic and memory leave:", least, "Critics in an update:", critics]
    compiled = {"size": "size", "precision": "precision", "as it is [ms]": "plain_ms", "compiled [ms]": "compiled_ms"}
    compiled |= {"to the former": "to_plain", "compiling [s]": "compile_s", "pays after": "pays_after"}
    parts += ["Updates with compiled networks:", pick(read("timing/time_compile.csv"), compiled)]
    pairs = {"what": "what", "size": "size", "precision": "precision", "before": "before", "before [ms]": "before_ms"}
    pairs |= {"now [ms]": "after_ms", "to the former": "ratio"}
    commits = [row for name in ("commits", "adapt") for row in read(f"timing/time_{name}.csv")]
    parts += ["As configured, before and after:", pick(commits, pairs)]
    maps = {"task": "task", "maps": "maps", "what": "what", "ms": "ms", "to none": "to_none"}
    parts += ["What the maps of a deployment cost:", pick(read("timing/time_maps.csv"), maps)]
    profile = {name: name for name in ("size", "precision", "operation", "ms", "calls")}
    large = [row for row in read("timing/profile_update.csv") if float(row["share"]) >= 0.03]
    shares = pick(large, {**profile, "share": ("share", percent)})
    return "\n\n".join([*parts, "Where an update's time goes:", shares, "On a GPU:", gpu()])


def gpu() -> str:
    """Networks with recorded work beside launched work, and what was measured once."""
    rows = read("timing/gpu_bench.csv")
    ways: dict[tuple[str, ...], dict[str, str]] = {}
    for row in rows:
        if row["size"] and not row["success"] and not row["per_second"]:
            ways.setdefault((row["what"], row["size"], row["precision"]), {})[row["recorded"]] = row["median_ms"]
    head = ["what", "size", "precision", "recorded [ms]", "launched [ms]"]
    networks = table(head, [[*key, of["True"], of["False"]] for key, of in ways.items()])
    says = [
        f"{r['count']} environments, physics={r['size']}, {r['device']}: {int(r['per_second']):,} control steps / s"
        for r in rows
        if r["what"] == "environment steps"
    ]
    says += [
        f"{r['what']}, {r['device']}, {int(r['count']):,} {unit}: {float(r['median_ms']) / 1000:.0f} s "
        f"({r['parts_s']}), success {percent(r['success'])}"
        for what, unit in (("pretrain push", "transitions"), ("fine-tune push", "rollouts"))
        for r in rows
        if r["what"] == what
    ]
    return "\n\n".join(
        [f"{rows[0]['device']}, PyTorch {rows[0]['torch']}:", networks, "\n".join(f"- {s}" for s in says)]
    )


def collect() -> str:
    head = {name: name for name in ("collector", "workers")}
    head |= {"start [s]": "start_s", "transitions / s": "steps_per_s", "to inline": "to_inline"}
    return pick(read("scale/time_collect.csv"), {**head, "bytes a transition": "bytes_per_step"})


def growth() -> str:
    """Plans by what they search, start-up times, and bytes of a rollout."""
    head: dict[str, str | tuple[str, Callable[[str], str]]]
    head = {"what": "what", "": "value", "takes": "amount", "unit": "unit", "to the default": "ratio"}
    rows = [row for row in read("scale/cost_growth.csv") if row["part"] != "start"]
    return pick([*rows, *read("scale/start.csv")], head)


def quality() -> str:
    head: dict[str, str | tuple[str, Callable[[str], str]]] = {"gap": "gap", "search": "variant"}
    head |= {"success": ("success", tenth), "low": ("success_low", tenth), "high": ("success_high", tenth)}
    head |= {"regret": "regret", "spread": "spread", "ms": "plan_ms"}
    parts = []
    for file, says in (
        ("plan_quality", "As configured, and cheaper:"),
        ("decay", "With fewer candidates after each iteration:"),
        ("wide", "The same of TD-MPC2's search, beside one ten times as wide as that:"),
        ("early", "Searches that stop early, or follow the spread of plans, and are not used:"),
        ("early_wide", "The same of a wide search:"),
    ):
        rows = [{**r, "variant": r["variant"] or "as configured"} for r in read(f"plan_quality/{file}.csv")]
        parts += [says, pick(rows, head)]
    ratio = pick(read("plan_quality/early_time.csv"), {"gap": "gap", "search": "variant", "to the configured": "ratio"})
    parts += ["Their time:", ratio]
    return "\n\n".join(parts)


def updates_per_s() -> float:
    """Updates that pretraining push makes on one thread."""
    (row,) = read("pretrain/parts.csv")
    return float(row["updates"]) / float(row["update_seconds"])


def thousand() -> str:
    """What a thousand workers would send and receive, by the arithmetic of one."""
    one = next(r for r in read("scale/time_collect.csv") if (r["collector"], r["workers"]) == ("process", "1"))
    rate, size, weights = (float(one[name]) for name in ("steps_per_s", "bytes_per_step", "weights_bytes"))
    round_s = float(one["median_s"])
    rows = [
        ["transitions a second", f"{1000 * rate:.3g}"],
        ["to the learner", f"{1000 * rate * size / 1e6:.0f} MB/s"],
        ["weights to the workers", f"{1000 * weights / 1e6:.0f} MB a round, {1000 * weights / round_s / 1e6:.0f} MB/s"],
        [
            "updates a second that 0.05 a transition asks for",
            f"{1000 * rate * 0.05:.3g}; by one worker {rate * 0.05:.3g}",
        ],
        ["updates a second that one core makes", f"{updates_per_s():.2g}"],
    ]
    return table(["1 000 workers", ""], rows)
