"""A run that goes on: its saved config, with what may change in it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, cast

from omegaconf import DictConfig, OmegaConf
from yaml import YAMLError

from mpc_sgft.command import choices
from mpc_sgft.command.compose import OPEN, check_key, check_kind, check_words, composed, parse, resolve
from mpc_sgft.command.counts import check_counts
from mpc_sgft.command.errors import UserError

STORED = ("model.", "train.replay.", "train.agent.entropy_coef")  # what a checkpoint holds: sizes, what has trained
TRAINED = {  # which parts of a model train, and on what
    "method.residual", "method.command_map", "method.command_band", "method.observation_map", "method.suspicion_margin",
    "method.encoder", "method.reward", "method.simulated_episodes", "method.slice_len", "method.gate_excess",
}  # fmt: skip
OPTIMISED = {"lr", "policy_lr", "command_lr", "observation_lr", "encoder_lr_share", "entropy_lr"}  # its optimisers hold


def resume(name: str, folder: str, overrides: Sequence[str], given: Sequence[str]) -> DictConfig:
    """The saved config of an earlier run, to go on with exactly; plain numbers may be changed, choices may not.

    What today's config gives as another setting, such as `${planner.horizon}`, and was the same, changes with it.

    Args:
        name: Command that is asked to resume.
        folder: Run folder with a config.yaml.
        overrides: Normalised overrides, `resume=` left out.
        given: The overrides as the user wrote them.

    Raises:
        UserError: If there is no such run, another command wrote it, its config is damaged, or an override cannot be
            applied.
    """
    path = Path(folder).resolve()
    if not (path / "config.yaml").is_file():
        raise UserError(f"cannot resume {folder}: no config.yaml in it. Give the run folder, e.g. runs/push/latest.")
    try:
        cfg = OmegaConf.load(path / "config.yaml")
    except (YAMLError, UnicodeDecodeError) as error:
        raise UserError(
            f"cannot resume {folder}: its config.yaml is damaged ({str(error).splitlines()[0]}). "
            "Put that of a run with the same settings there, or start a run."
        ) from error
    if not isinstance(cfg, DictConfig) or cfg.get("command") != name:
        wrote = cfg.get("command") if isinstance(cfg, DictConfig) else None
        raise UserError(f"cannot resume {folder} with {name}: {wrote or 'another program'} wrote it.")
    differs = [f"{t} has moved since" for t in _targets(cfg) if find_spec(t.rpartition(".")[0]) is None]
    taken_out = tuple(text[1:].partition("=")[0] for text in cfg.overrides if text.startswith("~"))
    today = _of_today(name, cfg)
    lacking = (key for key in _lacking(today, cfg) if not key.startswith(taken_out))
    differs += [f"it had no {key}" for key in lacking]
    if OmegaConf.select(cfg, "planner.temperature", default=0) > 1:
        differs += ["its planner.temperature was in reward units"]
    if differs:
        raise UserError(
            f"cannot resume {folder}: an earlier version wrote it ({differs[0]}). "
            "Go on with that version; versions.json there names its commit."
        )
    if OmegaConf.select(cfg, "backend.dry_run", default=False):
        raise UserError(f"cannot resume {folder}: it was a dry run, in which nothing moves. Start a run.")
    if "quiet" in cfg:
        cfg.quiet = False  # for each call anew: without a page there are no keys
    parsed, raw = parse(overrides), cast(dict[str, Any], OmegaConf.to_container(today))
    named = {override.key_or_group for override in parsed}
    for override in parsed:
        key = override.key_or_group
        if key == "backend.dry_run" and override.value():
            raise UserError("--dry-run is a run of its own. Leave --resume out; that run stays as it is.")
        if (
            key in (*choices.groups(), "run_dir", "checkpoint", "seed", "eval_seed")
            or key.startswith(("gap.", *STORED))
            or key.rpartition(".")[2] in OPTIMISED
            or key in TRAINED
            or override.is_delete()
        ):
            raise UserError(f"{key!r} cannot change in a resumed run. Start a new one, or leave it out.")
        if not key.startswith(OPEN):
            check_key(cfg, key)
        check_words(override)
        check_kind(OmegaConf.select(today, key, default=OmegaConf.select(cfg, key)), override)
        before = OmegaConf.select(cfg, key)
        followers = [other for other in _given_as(raw, key) if OmegaConf.select(cfg, other) == before]
        for changed in (key, *(other for other in followers if other not in named)):
            OmegaConf.update(cfg, changed, override.value(), force_add=changed.startswith(OPEN))
    resolve(cfg)
    check_counts(cfg)
    cfg.resume = cfg.run_dir = str(path)
    cfg.overrides = [*cfg.overrides, *given]
    OmegaConf.set_struct(cfg, True)
    return cfg


def _targets(node: Any) -> list[str]:
    """Our own classes and functions that a saved config names."""
    if isinstance(node, DictConfig):
        here = node.get("_target_")
        inner = [target for key in node if not OmegaConf.is_missing(node, key) for target in _targets(node[key])]
        return [here, *inner] if isinstance(here, str) and here.startswith("mpc_sgft.") else inner
    return []


def _of_today(name: str, cfg: DictConfig) -> DictConfig:
    """What a command's config has now with the choices of a saved one; their gap is a list of its own."""
    groups = choices.groups_of(name)
    chosen = {group: option for group, option in cfg.chosen.items() if option in groups.get(group, ())}
    kept = [f"{group}={option}" for group, option in chosen.items() if group not in ("gap", "experiment")]
    return composed(name, kept)


def _lacking(today: DictConfig, cfg: DictConfig, before: str = "") -> list[str]:
    """Settings of today's config that a saved one has not."""
    out = []
    for key in (str(key) for key in today if key != "hydra"):
        if key not in cfg:
            out.append(before + key)
        elif not OmegaConf.is_missing(today, key) and isinstance(OmegaConf.select(today, key), DictConfig):
            there = cfg[key]
            out += _lacking(today[key], there, f"{before}{key}.") if isinstance(there, DictConfig) else []
    return out


def _given_as(node: Mapping[str, Any], key: str, before: str = "") -> list[str]:
    """Settings of a composed config that are `${key}`; a saved one holds only what they were."""
    out = []
    for name, value in node.items():
        if isinstance(value, dict):
            out += _given_as(value, key, f"{before}{name}.")
        elif value == f"${{{key}}}":
            out.append(before + name)
    return out
