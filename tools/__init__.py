"""What a person runs by hand; `studies/` makes what results/ holds, `benchmarks/` times."""

import sys

MOVED = {
    "benchmarks": ("benchmark_env", "time_planner", "time_diagnose"),
    "studies": (
        *("check_stability", "close_the_loop", "critic_profile", "diagnose_table", "emps", "endure", "exact_dynamics"),
        *("nightly_franka_sim", "plot_study", "pretrain_study", "relearn", "study", "blind_benchmark"),
    ),
}


class _Moved:
    """Answers `python -m tools.NAME` of a tool that stands in another room now with its new name."""

    @staticmethod
    def find_spec(name: str, path: object = None, target: object = None) -> None:
        room = next((room for room, names in MOVED.items() if name.removeprefix("tools.") in names), None)
        if room and name.startswith("tools."):
            raise ModuleNotFoundError(f"{name} is tools.{room}.{name.removeprefix('tools.')} now", name=name)


sys.meta_path.append(_Moved)  # last: asked only where there is no such module
