"""From overrides to one config that holds only known names. The one place, with cli.py, that composes."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra import compose as hydra_compose
from hydra import initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import DictConfig, ListConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from mpc_sgft.command import choices
from mpc_sgft.command.counts import check_counts
from mpc_sgft.command.errors import UserError, unknown

ALIASES = {"horizon": "planner.horizon", "robot-ip": "backend.robot_ip", "dry-run": "backend.dry_run"}
RENAMED = {  # beginnings of overrides that had another name
    "transfer.": "method.",
    "train.agent.transfer_": "method.",
    "train.agent.anchor": "method.anchor",
    "train.agent.residual": "method.residual",
    "train.agent.command_": "method.command_",
}
FILES = {"gap": "effects", "randomize": "draws"}  # groups that a file may stand for, and the mapping that it must hold
OPEN = ("gap.effects.", "randomize.draws.")  # mappings that may gain keys on the command line
KINDS: tuple[tuple[type, tuple[type, ...], str], ...] = (  # of a default, and what may stand in its place
    (bool, (bool,), "true or false"),
    (int, (int,), "a whole number"),
    (float, (int, float), "a number"),
    (str, (str,), "a word"),
    (list, (list,), "a list"),
    (ListConfig, (list,), "a list"),
)
WHOLE = re.compile(r"=\d+(\.\d+)?[eE]\+?\d{1,2}")
FORM = re.compile(r"(?P<sign>\+\+|\+|~)?(?P<key>[A-Za-z_][\w./@-]*)(?P<rest>=.*)?", re.DOTALL)


def spread(given: Sequence[str]) -> list[str]:
    """The same overrides, with what they hold in place of `gap=FILE.yaml` and `randomize=FILE.yaml`.

    Raises:
        UserError: If the file is absent or does not hold effects, or draws.
    """
    out: list[str] = []
    for text in given:
        key, _, value = text.lstrip("+").partition("=")
        if key in FILES and value.endswith(".yaml"):
            out += [f"{key}=none", *(f"{key}.{name}={_literal(what)}" for name, what in _contents(key, value))]
        else:
            out.append(text)
    return out


def normalise(override: str) -> str:
    """Spell an override the way Hydra wants it.

    `horizon=8` sets the planner's horizon; effects of the gap and the experiment may be given with `+` or without; 1e6
    is 1000000.

    Raises:
        UserError: If it is not of the form key=value, or has another name now.
    """
    form = FORM.fullmatch(override)
    if form is None or (form["rest"] is None and form["sign"] != "~"):
        raise UserError(f"cannot read {override!r}. Write overrides as key=value, e.g. seed=1; --help lists the names.")
    sign, key, rest = form["sign"] or "", form["key"], form["rest"] or ""
    if WHOLE.fullmatch(rest) and float(rest[1:]).is_integer():  # 1e6 counts, too
        rest = f"={int(float(rest[1:]))}"
    for old, new in RENAMED.items():
        if key.startswith(old):
            raise UserError(f"{key} is called {new}{key.removeprefix(old)} now: {new}{key.removeprefix(old)}{rest}")
    key = ALIASES.get(key, key)
    if sign != "~" and key.startswith(OPEN):
        sign = "++"
    elif sign != "~" and key == "experiment":
        sign = "+"
    return f"{sign}{key}{rest}"


def parse(overrides: Sequence[str]) -> list[Override]:
    """Read normalised overrides with Hydra's grammar.

    Raises:
        UserError: If a value cannot be read.
    """
    parser = OverridesParser.create()
    try:
        return [parser.parse_override(text) for text in overrides]
    except HydraException as err:
        raise UserError(f"{first_line(err)} Quote values that hold commas, spaces or =: key='\"...\"'.") from err


def check(name: str, overrides: Sequence[str], sweep: bool) -> None:
    """Refuse unknown groups, options, keys, and values of another kind, before anything is composed for good.

    Args:
        name: Command, the config's file name.
        overrides: Normalised overrides.
        sweep: Whether several values per key are allowed (-m).

    Raises:
        UserError: Which name or value, and what is allowed.
    """
    groups = choices.groups_of(name)
    parsed = parse(overrides)
    base_overrides = []
    for override in parsed:
        if override.is_sweep_override() and not sweep:
            raise UserError(f"{override.input_line!r} gives several values. Add -m to run them one after the other.")
        key = override.key_or_group
        if key not in groups:
            if key in choices.groups():
                raise UserError(f"{name} has no {key}=. Its groups: {', '.join(groups)}.")
            continue
        options = _values(override)
        for option in options:
            if option not in groups[key]:
                raise unknown(key, option, groups[key], f"configs/{key}/")
        if override.is_delete() or not options or (isinstance(override.value(), list) and key != "experiment"):
            raise UserError(f"{override.input_line!r}: one {key} is needed. Available: {', '.join(groups[key])}.")
        base_overrides.append(f"{'+' if override.is_add() else ''}{key}={options[0]}")
    base = composed(name, base_overrides)
    for override in parsed:
        key = override.key_or_group
        if key in groups or key.startswith(("hydra.", "hydra/")):
            continue
        if not override.is_delete() and key.startswith(OPEN):
            if (group := key.partition(".")[0]) not in groups:
                raise UserError(f"{key}: {name} has no {group}. Its groups: {', '.join(groups)}.")
            continue
        check_key(base, key)
        check_words(override)
        if not (override.is_delete() or override.is_sweep_override()):
            check_kind(OmegaConf.select(base, key), override)


def compose(name: str, overrides: Sequence[str], given: Sequence[str]) -> DictConfig:
    """The config of one run: every key known, paths absolute, with the names that were chosen.

    Args:
        name: Command, the config's file name.
        overrides: Normalised overrides.
        given: The overrides as the user wrote them, kept for the record.

    Raises:
        UserError: If they do not make a config.
    """
    cfg = composed(name, overrides)
    chosen = {group: cfg.hydra.runtime.choices.get(group) for group in choices.groups()}
    with open_dict(cfg):
        del cfg["hydra"]
    return complete(cfg, name, chosen, given)


def complete(cfg: DictConfig, name: str, chosen: Mapping[str, str | None], given: Sequence[str]) -> DictConfig:
    """Add `command`, `chosen` (group -> option) and `overrides` to a composed config, and check what only it can show.

    Raises:
        UserError: On an unknown effect, a count that is too small, or an interpolation that leads nowhere.
    """
    for effect in OmegaConf.select(cfg, "gap.effects") or {}:
        if effect not in choices.effects():
            raise unknown("effect", str(effect), choices.effects(), "envs/effects/")
    bare = [text.lstrip("+") for text in given]
    gap_changes = [text.removeprefix("gap.effects.") for text in bare if text.startswith("gap.effects.")]
    names = {group: option for group, option in chosen.items() if option is not None}
    if gap_changes:
        names["gap"] = "+".join([names["gap"], *gap_changes])
    with open_dict(cfg):
        cfg.command = name
        cfg.chosen = names
        cfg.overrides = list(given)
        # Links are followed now: runs/latest moves as soon as this run's own folder exists.
        for key in ("checkpoint", "resume"):
            if cfg[key] is not None and Path(str(cfg[key])).exists():
                cfg[key] = str(Path(str(cfg[key])).resolve())
    resolve(cfg)
    check_counts(cfg)
    OmegaConf.set_struct(cfg, True)
    return cfg


def complete_job(cfg: DictConfig, name: str) -> DictConfig:
    """As `complete`, for the job of a sweep that is running now."""
    job = HydraConfig.get()
    chosen = {group: job.runtime.choices.get(group) for group in choices.groups()}
    return complete(cfg, name, chosen, list(job.overrides.task))


def first_line(err: BaseException) -> str:
    """First line of a message, with a full stop."""
    text = str(err).strip()
    line = text.splitlines()[0].strip() if text else type(err).__name__
    return line if line.endswith((".", "?", "!")) else line + "."


def composed(name: str, overrides: Sequence[str]) -> DictConfig:
    """What Hydra makes of normalised overrides, its own settings included.

    Raises:
        UserError: If it refuses them.
    """
    sweep = GlobalHydra.instance().hydra  # a job of a sweep composes while Hydra runs it
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(version_base="1.3", config_dir=str(choices.CONFIG_DIR), job_name=name):
            return hydra_compose(config_name=name, overrides=list(overrides), return_hydra_config=True)
    except (HydraException, OmegaConfBaseException) as err:
        raise UserError(first_line(err)) from err
    finally:
        GlobalHydra.instance().hydra = sweep


def resolve(cfg: DictConfig) -> None:
    """Put numbers in the place of references, in `cfg` itself.

    Raises:
        UserError: If one leads nowhere.
    """
    try:
        OmegaConf.resolve(cfg)
    except OmegaConfBaseException as err:
        raise UserError(f"the config cannot be resolved: {first_line(err)}") from err


def _contents(group: str, path: str) -> list[tuple[str, Any]]:
    """Names below a group and their values, from a file of one's own."""
    key = FILES[group]
    try:
        content = OmegaConf.to_container(OmegaConf.load(path))
    except FileNotFoundError as err:
        names = ", ".join(choices.groups()[group])
        raise UserError(f"{group}={path}: no such file. Give one with `{key}:`, or a name: {names}.") from err
    except (YAMLError, OmegaConfBaseException, OSError, UnicodeDecodeError) as err:
        raise UserError(f"{group}={path}: cannot be read: {first_line(err)}") from err
    inner = content.pop(key, None) if isinstance(content, dict) else None
    if not isinstance(content, dict) or not isinstance(inner, dict):
        form = {"gap": "<effect>: {<parameter>: <value>}", "randomize": "<draw>: {fields: [...], low: .., high: ..}"}
        raise UserError(f"{group}={path}: it needs one key, `{key}:`, with {{{form[group]}}} under it.")
    beside = [] if group == "gap" else [(str(name), what) for name, what in content.items()]
    return beside + [(f"{key}.{name}", what) for name, what in inner.items()]


def _literal(value: Any) -> str:
    """A value of a yaml file in Hydra's grammar."""
    if isinstance(value, dict):
        return "{" + ",".join(f"{k}:{_literal(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ",".join(map(_literal, value)) + "]"
    if isinstance(value, str):
        return "'" + value.replace("'", "\\'") + "'"
    return json.dumps(value)


def _values(override: Override) -> list[str]:
    """The words an override may take: one, or those of a simple sweep or list; none for null and for ranges."""
    if override.is_delete():
        return []
    if override.is_sweep_override():
        return [word.strip("'\"") for word in override.sweep_string_iterator()] if override.is_choice_sweep() else []
    value = override.value()
    if value is None:
        return []
    return [str(item) for item in value] if isinstance(value, list) else [str(value)]


def check_key(cfg: Any, key: str) -> None:
    """Raise UserError with the names that exist if a config has no such key."""
    node, before = cfg, ""
    for part in key.replace("/", ".").split("."):
        if isinstance(node, ListConfig) and part.isdigit() and int(part) < len(node):
            node = node[int(part)]
        elif isinstance(node, DictConfig) and part in node:
            node = OmegaConf.select(node, part)
        else:
            names = [str(name) for name in node if name != "hydra"] if isinstance(node, DictConfig) else []
            aliases = [] if before else ALIASES
            raise unknown("override" if not before else f"key of {before.rstrip('.')}", part, [*names, *aliases])
        before += part + "."


def check_words(override: Override) -> None:
    """Raise UserError if a setting that takes one of a few words gets another."""
    key = override.key_or_group
    for word in _values(override) if key in choices.WORDS else []:
        if word not in choices.WORDS[key]:
            raise unknown(key, word, choices.WORDS[key])


def check_kind(default: Any, override: Override) -> None:
    """Raise UserError if a value is of another kind than the default that it replaces."""
    value = override.value()
    if type(default) is int and override.key_or_group.rpartition(".")[2].isdigit():
        default = float(default)  # of a list, whose other numbers may have fractions
    for kind, allowed, words in KINDS:
        if isinstance(default, kind):
            right = isinstance(value, allowed) and (kind is bool or not isinstance(value, bool))
            interpolated = isinstance(value, str) and "${" in value
            if not (right or value is None or interpolated or (kind is str and not isinstance(value, dict | list))):
                raise UserError(f"{override.input_line!r}: {words} is needed, as in {override.key_or_group}={default}.")
            return
