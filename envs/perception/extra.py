"""Libraries of the `camera` extra, loaded when they are first needed."""

from importlib import import_module
from typing import Any

from envs.perception.base import PerceptionError


def load(name: str) -> Any:
    """The module `cv2` or `pyrealsense2`.

    Raises:
        PerceptionError: If it, or the system library below it, is not installed.
    """
    try:
        return import_module(name)
    except ImportError as err:
        if "libusb" in str(err):
            raise PerceptionError(f"{name} needs libusb: sudo apt-get install libusb-1.0-0 (or make system).") from err
        if isinstance(err, ModuleNotFoundError) and err.name == name:
            raise PerceptionError(
                f"Cameras need {name}: pip install 'mpc_sgft[camera]' (Linux or Windows on x86-64)."
            ) from err
        raise PerceptionError(f"{name} is installed but does not load: {err}.") from err
