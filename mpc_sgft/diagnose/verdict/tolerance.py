"""How well the model must predict, in the units of the signals: what the user calls good enough."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mpc_sgft.command.errors import UserError
from mpc_sgft.diagnose.data.mapping import UNITS
from mpc_sgft.diagnose.data.measured import Array
from mpc_sgft.diagnose.fitting.fit import Fit

Predict = Callable[[Sequence[Fit]], Array]  # K fits -> predictions of all windows, [K, W, n, S]
FITTING = {  # unit of a signal -> those that a tolerance may be given in
    "m": ("m", "cm", "mm", "um"),
    "rad": ("rad", "mrad", "deg"),
    "m/s": ("m/s", "mm/s"),
    "rad/s": ("rad/s", "deg/s"),
    "N or N m": ("N", "mN", "Nm", "mNm"),
}
SMALL = 0.01  # of a signal's standard deviation: what changes predictions by less may be a trace if nobody says


@dataclass(frozen=True)
class Tolerance:
    """Root mean square errors, over windows that each start at the measured state, that may not matter.

    Args:
        limits: Of each signal in its unit, [S]; infinite where any error will do.
        predict: Fits -> predictions.
        measured: [W, n, S], without what the simulator's time step is known to leave out.
        noise: Of each signal, [S].
        asked: Whether the user gave it: what is within it then does not matter, however large a share of the error.
    """

    limits: Array
    predict: Predict
    measured: Array
    noise: Array
    asked: bool

    def allows(self, f: Fit) -> bool:
        """Whether the user said that a fit's own error, without the noise, may be left as it is."""
        if not self.asked:
            return False
        missed = ((self.predict([f])[0] - self.measured) ** 2).mean((0, 1)) - self.noise**2
        return bool((missed <= self.limits**2).all())

    def alike(self, a: Fit, b: Fit, told: Array, times: float = 1.0) -> bool:
        """Whether two fits predict the same but for so many times the tolerance, on windows of these weights [W]."""
        return bool(self.shares([a, b], told)[0] <= times)

    def shares(self, fits: Sequence[Fit], told: Array) -> Array:
        """How far the first fit and each other predict apart, in tolerances of the worst signal, [K - 1].

        Args:
            fits: K of them.
            told: Weights of windows, [W].
        """
        y = self.predict(fits)
        apart = np.einsum("w,kwns->ks", told, (y[1:] - y[:1]) ** 2) / y[0, ..., 0].size
        alike = np.zeros_like(apart)  # also where nothing is tolerated
        return np.sqrt(np.divide(apart, self.limits**2, out=alike, where=apart > 0).max(-1))


def spread_of(measured: Array, predicted: Array, units: Sequence[str]) -> Array:
    """How far signals move, [S]: standard deviations.

    One that stands still has the least of those of its unit that move; if that is less, or there is none, that of what
    the nominal model says.

    Args:
        measured, predicted: [W, n, S].
        units: Of the signals.
    """
    spread, foretold = (x.reshape(-1, len(units)).std(0) for x in (measured, predicted))
    moves, unit_of = np.ptp(measured, axis=(0, 1)) > 0, np.array(units)
    for i in np.flatnonzero(~moves).tolist():
        others = spread[moves & (unit_of == units[i])]
        spread[i] = max(foretold[i], others.min() if len(others) else 0.0)
    return spread


def parse_tolerance(text: str) -> float | dict[str, str]:
    """`1%` -> 0.01, a share; `qpos/j=0.5mm,qpos/k=0.1deg` -> {signal: number with unit}.

    Raises:
        UserError: If it is neither.
    """
    if "=" not in text:
        number = text.strip().removesuffix("%")
        try:
            return float(number) / (100 if "%" in text else 1)
        except ValueError as error:
            raise _unreadable(text) from error
    parts = (item.partition("=") for item in text.split(",") if item.strip())
    return {name.strip(): value.strip() for name, _, value in parts}


def limits_of(
    tolerance: float | Mapping[str, float | str] | None, signals: Sequence[str], units: Sequence[str], spread: Array
) -> Array:
    """Tolerated root mean square error of each signal in its unit, [S].

    Args:
        tolerance: A share of each signal's spread, SMALL if None; or signal -> number in its unit, or with a unit of
            its own. Signals that are not named do not count.
        signals, units: That are compared.
        spread: Standard deviation of each, [S].

    Raises:
        UserError: For a signal that is not compared, or a number that cannot be.
    """
    if tolerance is None:
        return SMALL * spread
    if isinstance(tolerance, int | float):
        if not 0 < tolerance < 1:
            raise UserError(f"--tolerance {tolerance:g}: a share of the motion is between 0 and 1, such as 1%.")
        return tolerance * spread
    limits = np.full(len(signals), np.inf)
    for name, value in tolerance.items():
        if name not in signals:
            raise UserError(f"--tolerance: {name!r} is no compared signal. There are: {', '.join(signals)}.")
        i = list(signals).index(name)
        limits[i] = _in_unit(name, value, units[i])
    return limits


def _in_unit(name: str, value: float | str, unit: str) -> float:
    known = FITTING.get(unit, ())
    match = re.fullmatch(r"([0-9.eE+-]+?)\s*([a-zA-Z/]*)", str(value))
    if match is None or match[2] and match[2] not in known:
        allowed = ", ".join(known) or "a plain number"
        raise UserError(f"--tolerance {name}={value}: no size of this signal. Units that fit: {allowed}.")
    try:
        number = float(match[1]) * UNITS[match[2]]
    except ValueError as error:
        raise _unreadable(f"{name}={value}") from error
    if not (np.isfinite(number) and number > 0):
        raise UserError(f"--tolerance {name}={value}: a number above 0 is needed.")
    return number


def _unreadable(text: str) -> UserError:
    return UserError(f"--tolerance {text!r}: write a share of the motion, 1%, or signal=number, qpos/j=0.5mm.")
