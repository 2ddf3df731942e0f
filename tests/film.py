"""A recording by librealsense's software camera, for tests: run as a script, because the recorder lets go of its file
only when its process ends. Reads {"path", "serial", "lens", "late_ms"}; pictures color [n, H, W, 3] and depth
[n, H, W] mm, or none, come in an .npz file."""

import json
import sys
import time
from typing import Any

import numpy as np
import pyrealsense2 as rs

PERIOD_MS = 1000 / 30


def stream(lens: dict, kind: Any, form: Any, uid: int, bpp: int) -> Any:
    described, video = rs.intrinsics(), rs.video_stream()
    described.width, described.height, described.fx, described.fy = (lens[k] for k in ("width", "height", "fx", "fy"))
    described.ppx, described.ppy, described.model, described.coeffs = (
        lens["cx"],
        lens["cy"],
        rs.distortion.none,
        [0.0] * 5,
    )
    video.type, video.fmt, video.index, video.uid, video.bpp = kind, form, 0, uid, bpp
    video.width, video.height, video.fps, video.intrinsics = lens["width"], lens["height"], 30, described
    return video


def main(order: dict, pictures: dict[str, np.ndarray]) -> None:
    device = rs.software_device()
    device.register_info(rs.camera_info.serial_number, order["serial"])
    device.register_info(rs.camera_info.name, "software camera")
    sensor = device.add_sensor("Stereo")
    sent = [(sensor.add_video_stream(stream(order["lens"], rs.stream.color, rs.format.rgb8, 2, 3)), pictures["color"])]
    if "depth" in pictures:
        sensor.add_read_only_option(rs.option.depth_units, 0.001)
        sent.append(
            (sensor.add_video_stream(stream(order["lens"], rs.stream.depth, rs.format.z16, 1, 2)), pictures["depth"])
        )
    recorder = rs.recorder(order["path"], device)
    recorded = recorder.query_sensors()[0]
    queue = rs.frame_queue(4 * len(pictures["color"]))
    recorded.open(recorded.get_stream_profiles())
    recorded.start(queue)
    for k in range(len(pictures["color"])):
        for (profile, data), late in zip(sent, (0.0, order["late_ms"]), strict=False):
            picture = np.ascontiguousarray(data[k])
            frame = rs.software_video_frame()
            frame.pixels, frame.stride, frame.bpp = picture, picture.strides[0], picture.strides[1]
            frame.profile, frame.frame_number = profile.as_video_stream_profile(), k
            frame.domain, frame.depth_units = rs.timestamp_domain.system_time, 0.001
            frame.timestamp = 1e6 + k * PERIOD_MS + late
            sensor.on_video_frame(frame)
            time.sleep(0.005)  # the recorder writes in a thread of its own and drops what it cannot keep up with
    for _ in range(len(sent) * len(pictures["color"])):
        assert queue.try_wait_for_frame(2000)[0], "the software camera lost a frame"
    recorded.stop()
    recorded.close()


if __name__ == "__main__":
    with np.load(sys.argv[1]) as file:
        main(json.load(sys.stdin), dict(file))
