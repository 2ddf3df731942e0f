"""Starting librealsense's pipeline, on a camera or on what one recorded."""

from pathlib import Path
from typing import Any

from envs.perception.base import PerceptionError
from envs.perception.extra import load


def start_camera(serial: str, *, depth: bool, width: int, height: int, fps: int) -> tuple[Any, Any]:
    """A running pipeline and its profile.

    Raises:
        PerceptionError: If the camera is not connected or does not have such streams.
    """
    rs = load("pyrealsense2")
    connected = [device.get_info(rs.camera_info.serial_number) for device in rs.context().query_devices()]
    if serial not in connected:
        raise PerceptionError(
            f"camera {serial} is not connected; connected are: {', '.join(connected) or 'none'}. Check the USB 3"
            " cable and librealsense's udev rules, or calibrate the camera that is there."
        )
    pipeline, config = rs.pipeline(), rs.config()
    config.enable_device(serial)
    config.enable_stream(rs.stream.color, width, height, rs.format.rgb8, fps)
    if depth:
        config.enable_stream(rs.stream.depth, width, height, rs.format.z16, fps)
    try:
        return pipeline, pipeline.start(config)
    except RuntimeError as err:
        raise PerceptionError(
            f"camera {serial} does not start with color{' and depth' * depth} at {width}x{height}, {fps}/s: {err}."
        ) from err


def start_recording(path: str | Path) -> tuple[Any, Any]:
    """A running pipeline that hands out every frame of a .db3 file as fast as it is read, and its profile.

    The recording's own pace is switched off before the start: with it, librealsense 2.59 crashes now and then when a
    pipeline is stopped (playback_device::prefetch_done).

    Raises:
        PerceptionError: If there is no such file or it is not a recording.
    """
    rs = load("pyrealsense2")
    if not Path(path).is_file():
        raise PerceptionError(f"there is no recording {path}.")
    pipeline, config = rs.pipeline(), rs.config()
    try:
        rs.config.enable_device_from_file(config, str(path), repeat_playback=False)
        config.resolve(rs.pipeline_wrapper(pipeline)).get_device().as_playback().set_real_time(False)
        return pipeline, pipeline.start(config)
    except RuntimeError as err:
        raise PerceptionError(f"{path} does not start: {err}.") from err


def stop(pipeline: Any) -> None:
    """Stop a running pipeline.

    The thread that reads a recording outlives librealsense's own stop, and crashes when its device is gone. So the
    device is held until pausing it, which waits for that thread, has returned.
    """
    device = pipeline.get_active_profile().get_device()
    pipeline.stop()
    if device.is_playback():
        device.as_playback().pause()
