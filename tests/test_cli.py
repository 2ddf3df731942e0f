"""The front of the commands, as a user meets it: help, names, exit codes, overrides."""

from __future__ import annotations

import gc
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from omegaconf import OmegaConf

from envs.effects import available
from mpc_sgft.command import choices, cli, compose
from mpc_sgft.command.errors import Stopped, UserError, from_config
from tests.probes import probe

ROOT = Path(__file__).resolve().parents[1]
COMMANDS = ("pretrain", "deploy", "evaluate")


@pytest.mark.parametrize("name", COMMANDS)
def test_help_lists_the_names_and_loads_nothing_heavy(name: str, tmp_path: Path) -> None:
    code = (
        "import sys; sys.argv = ['x', '--help']\n"
        f"from mpc_sgft import {name}\n"
        f"try: {name}.main()\n"
        "except SystemExit as stop: assert stop.code == 0\n"
        "heavy = {'torch', 'hydra', 'mujoco', 'rerun', 'numpy'}\n"
        "print('LOADED', sorted({m.split('.')[0] for m in sys.modules} & heavy))\n"
    )
    env = {"PYTHONPATH": str(ROOT), "PATH": "/usr/bin"}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=env, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    assert "LOADED []" in done.stdout
    for group in ("task", "gap", "planner"):
        options = ", ".join(choices.groups()[group])
        assert options in re.sub(r",\s+", ", ", done.stdout), group
    assert all(effect in done.stdout for effect in choices.effects())


def test_a_deployment_starts_without_what_few_runs_need() -> None:
    code = (
        "import sys, mpc_sgft.runs.deploy\nprint('LOADED', sorted({'scipy', 'matplotlib', 'plotly'} & {*sys.modules}))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert "LOADED []" in done.stdout, done.stderr


def test_groups_and_effects_are_the_files_on_disk() -> None:
    assert {"task", "gap", "planner", "model", "backend", "experiment"} <= set(choices.groups())
    assert "none" in choices.groups()["gap"]
    assert "actuator_gain" in choices.effects() and tuple(choices.effects()) == available()


@pytest.mark.parametrize(
    ("args", "parts"),
    [
        (["task=pusch"], ["unknown task 'pusch'", "Did you mean 'push'", "pendulum"]),
        (["gap=nonne"], ["unknown gap 'nonne'", "none"]),
        (["planner=mpii"], ["unknown planner 'mpii'", "mppi", "cem"]),
        (["model=smal"], ["unknown model 'smal'", "small"]),
        (["--backend", "ur5"], ["unknown backend 'ur5'", "franka, sim"]),
        (["+experiment=debgu"], ["unknown experiment 'debgu'", "debug"]),
        (["gap.effects.actuator_gian.gain=1"], ["unknown effect 'actuator_gian'", "actuator_gain", "sensor_delay"]),
        (["sed=1"], ["unknown override 'sed'", "Did you mean 'seed'"]),
        (["+foo=1"], ["unknown override 'foo'"]),
        (["horzon=8"], ["unknown override 'horzon'", "Did you mean 'horizon'"]),
        (["planner.horizn=8"], ["unknown key of planner 'horizn'", "Did you mean 'horizon'"]),
        (["transfer.updates=5"], ["transfer.updates is called method.updates now: method.updates=5"]),
        (["train.agent.transfer_lr=1"], ["method.lr=1"]),
        (["method=sgtf"], ["unknown method 'sgtf'", "sgft", "zero_shot"]),
        (["device=gpu"], ["unknown device 'gpu'", "cuda"]),
        (["seed=one"], ["a whole number is needed"]),
        (["planner.num_candidates=1.5"], ["a whole number is needed, as in planner.num_candidates="]),
        (["planner.temperature=hot"], ["a number is needed"]),
        (["eval_every=0"], ["eval_every=0: a whole number from 1 on"]),
        (["train.replay.batch_size=0"], ["train.replay.batch_size=0: a whole number from 1 on"]),
        (["method.slice_len=0"], ["method.slice_len=0: a whole number from 1 on"]),
        (["warmup=-1"], ["warmup=-1: a whole number from 0 on"]),
        (["seed=-1"], ["a whole number"]),
        (["eval_seed=-1"], ["eval_seed=-1: a whole number"]),
        (["seed=1,2"], ["Add -m"]),
        (["task=null"], ["one task is needed"]),
        (["randomize=push"], ["deploy has no randomize="]),
        (["randomize.draws.x.low=0.3"], ["randomize.draws.x.low: deploy has no randomize", "gap"]),
        (["--bakend", "sim"], ["unknown flag '--bakend'", "--backend"]),
        (["--seed"], ["--seed", "expected one argument"]),
        (["push"], ["key=value"]),
        (["--resume", "nowhere"], ["cannot resume nowhere", "config.yaml"]),
        (["-m", "gap=none,nonne"], ["unknown gap 'nonne'"]),
        (["-m", "run_dir=runs/a", "seed=1,2"], ["shared by all runs"]),
    ],
)
def test_what_does_not_exist_is_one_line_and_exit_2(args: list[str], parts: list[str], capsys) -> None:
    from mpc_sgft import deploy

    assert deploy.main(args) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and error.count("\n") == 1, error
    for part in parts:
        assert part in error


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("randomize.noise=0.5", "unknown key of randomize 'noise'"),
        ("randomize.mass.low=0.5", "unknown key of randomize 'mass'"),
        ("randomize=found.yaml", "unknown key of randomize 'noise_sdd'"),
        ("train.replay.capacity=60", "a round of 80 transitions does not fit train.replay.capacity=60"),
        ("train.replay.slice_len=50", "slice_len=50: an episode has 1 to 20 steps"),
        ("planner.num_candidates=6", "num_elites"),
        ("final_episodes=0", "final_episodes=0: a whole number from 1 on"),
        ("detours.share=2", "detours.share=2: a share"),
        ("detours.rest=null", "detours.rest=None: a share"),
        ("detours.steps=null", "detours.steps=(): from and to"),
        ("detours.steps=[5,2]", "detours.steps=[5, 2]: from and to"),
    ],
)
def test_pretraining_says_what_is_wrong_before_it_begins(words: str, says: str, loops: Path, capsys) -> None:
    from mpc_sgft import pretrain

    Path("found.yaml").write_text("{noise_sdd: 0.5, draws: {}}")
    tiny = ["+experiment=debug", "task=pendulum", "task.env.episode_steps=20", "num_envs=4", "--quiet"]
    assert pretrain.main([*tiny, "run_dir=run", words]) == 2
    assert says in capsys.readouterr().err and not Path("run/checkpoint").exists()


@pytest.mark.parametrize("name", COMMANDS)
def test_a_real_process_ends_with_2_and_no_traceback(name: str, command) -> None:
    done = command(name, "task=pusch")
    assert done.returncode == 2
    assert "Traceback" not in done.stderr and done.stderr.startswith("error: unknown task 'pusch'")


@pytest.mark.parametrize(
    ("args", "shown"),
    [
        ([], "0 none 4"),
        (["--seed", "3"], "3 none 4"),
        (["horizon=8"], "0 none 8"),
        (["planner.horizon=2", "planner=cem"], "0 none 2"),
        (["planner.horizon=2e0"], "0 none 2"),
        (["+gap.effects.actuator_gain.gain=0.6"], "0 none+actuator_gain.gain=0.6 4"),
        (["gap.effects.actuator_gain.gain=0.6", "gap=none"], "0 none+actuator_gain.gain=0.6 4"),
    ],
)
def test_overrides_reach_the_loop(args: list[str], shown: str, loops: Path, capsys) -> None:
    assert cli.run(probe("show"), args) == 0
    assert capsys.readouterr().out.strip() == shown


def test_imports_collect_no_garbage_and_the_loop_does(loops: Path, capsys) -> None:
    assert cli.run(probe("garbage"), []) == 0
    assert capsys.readouterr().out.split() == ["False", "True", "True"]
    assert gc.isenabled() and gc.get_freeze_count() == 0


def test_a_sweep_runs_each_value(loops: Path, capfd) -> None:
    assert cli.run(probe("show"), ["seed=1,2", "-m", "horizon=1"]) == 0
    out = capfd.readouterr().out
    assert "1 none 1" in out and "2 none 1" in out
    assert [path.name for path in loops.iterdir()] == ["runs"]


def test_a_job_of_a_sweep_composes_for_itself(loops: Path, capfd) -> None:
    assert cli.run(probe("compose_anew"), ["seed=1,2", "-m"]) == 0
    out = capfd.readouterr().out
    assert "1 7" in out and "2 7" in out


def test_a_sweep_passes_hydras_own_errors_on(loops: Path, capsys) -> None:
    assert cli.run(probe("show"), ["seed=1,2", "-m", "hydra/launcher=nowhere"]) == 2
    assert "hydra/launcher/nowhere" in capsys.readouterr().err


def test_ctrl_c_shows_the_message_of_the_loop(loops: Path, capsys) -> None:
    assert cli.run(probe("stop"), []) == 130
    assert "Saved. Go on with: --resume runs/x" in capsys.readouterr().err


def test_a_full_disk_is_a_clear_line(loops: Path, capsys) -> None:
    assert cli.run(probe("full"), []) == 2
    assert re.search(r"runs/x/metrics.csv: the disk is full\. .*another place with run_dir=", capsys.readouterr().err)
    assert cli.run(probe("folder"), ["run_dir=first"]) == 0
    assert cli.run(probe("full"), ["--resume", "first"]) == 2
    said = capsys.readouterr().err
    assert "the same --resume goes on" in said and "run_dir" not in said, "a resumed run is where it is"


def test_errors_of_our_own_are_not_hidden(loops: Path) -> None:
    with pytest.raises(BrokenPipeError):
        cli.run(probe("bug"), [])


def test_a_gap_may_be_a_file(loops: Path, capsys) -> None:
    """As diagnose writes it: names, lists, several places, small numbers, and nothing at all."""
    effects = {
        "coulomb_friction": [{"torque": 1e-7, "at": ["fr3_joint1"]}, {"torque": -2.5, "at": ["qpos/elbow, left"]}],
        "actuator_offset": {"offset": [0.1, -0.2]},
        "payload": {"mass": 2, "position": [0.0, 0.0, 0.1], "at": "link7"},
        "deadband": None,
    }
    Path("found.yaml").write_text("# a comment\n" + yaml.safe_dump({"effects": effects}))
    given = compose.spread(["seed=1", "gap=found.yaml", "gap.effects.payload.mass=3"])
    cfg = compose.compose("deploy", [compose.normalise(text) for text in given], given)
    effects["payload"]["mass"] = 3  # pyright: ignore
    assert OmegaConf.to_container(cfg.gap.effects) == effects and cfg.seed == 1
    assert "+coulomb_friction=[{" in cfg.chosen.gap
    Path("one.yaml").write_text("effects: {actuator_gain: {gain: 0.6}}")
    assert cli.run(probe("show"), ["gap=one.yaml"]) == 0
    assert capsys.readouterr().out == "0 none+actuator_gain={gain:0.6} 4\n"


def test_a_randomisation_may_be_a_file(loops: Path) -> None:
    """It replaces the task's own, what is drawn and what is not."""
    draws = {"mass": {"fields": ["body_mass"], "at": ["puck"], "low": 0.9, "high": 1e2, "distribution": "loguniform"}}
    Path("found.yaml").write_text(yaml.safe_dump({"noise_sd": 0.002, "draws": draws}))
    given = compose.spread(["randomize=found.yaml"])
    cfg = compose.compose("pretrain", [compose.normalise(text) for text in given], given)
    assert OmegaConf.to_container(cfg.randomize) == {"noise_sd": 0.002, "noise_probability": 0.0, "draws": draws}
    for text, words in (("noise_sd: 1", "it needs one key, `draws:`"), (None, "or a name: .*push_wide")):
        Path("found.yaml").unlink() if text is None else Path("found.yaml").write_text(text)
        with pytest.raises(UserError, match=words):
            compose.spread(["randomize=found.yaml"])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, "no such file. Give one with `effects:`, or a name: "),
        ("effects: [", "cannot be read"),
        ("payload: {mass: 1}", "it needs one key, `effects:`"),
        ("- 1", "it needs one key, `effects:`"),
        ("effects: {paiload: {mass: 1}}", "unknown effect 'paiload'"),
    ],
)
def test_a_gap_file_that_is_none(text: str | None, words: str, loops: Path, capsys) -> None:
    if text is not None:
        Path("gap.yaml").write_text(text)
    assert cli.run(probe("show"), ["gap=gap.yaml"]) == 2
    assert words in capsys.readouterr().err


@pytest.mark.parametrize("name", COMMANDS)
@pytest.mark.parametrize("experiment", choices.groups()["experiment"])
def test_experiments_change_numbers_and_add_no_keys(name: str, experiment: str) -> None:
    def keys(cfg, prefix: str = "") -> set[str]:
        return (
            set().union(*({prefix + k} | keys(v, f"{prefix}{k}.") for k, v in cfg.items()))
            if isinstance(cfg, dict)
            else set()
        )

    written = OmegaConf.to_container(OmegaConf.load(choices.CONFIG_DIR / "experiment" / f"{experiment}.yaml"))
    assert isinstance(written, dict)
    written.pop("defaults", None)
    known: set[str] = set()
    for each in COMMANDS:  # one experiment serves the three commands, which differ in their groups
        known |= keys(OmegaConf.to_container(compose.compose(each, [], [])))
    unknown = {key for key in keys(written) if key not in known and not key.startswith(("gap.effects.", "randomize."))}
    assert not unknown
    compose.compose(name, [f"+experiment={experiment}"], [])


@pytest.mark.parametrize("name", COMMANDS)
@pytest.mark.parametrize("group", ["task", "gap", "planner", "model", "train", "randomize", "backend"])
def test_every_option_of_every_group_composes(name: str, group: str) -> None:
    for option in choices.groups_of(name).get(group, []):
        cfg = compose.compose(name, [f"{group}={option}"], [])
        assert cfg.chosen[group] == option


def test_wrong_values_found_while_building_are_the_users() -> None:
    with pytest.raises(UserError, match="planner: horizon=0: at least 1"), from_config("planner"):
        raise ValueError("horizon=0: at least 1")
    with pytest.raises(ZeroDivisionError), from_config("planner"):
        raise ZeroDivisionError
    assert issubclass(Stopped, KeyboardInterrupt)
