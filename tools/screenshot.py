"""Open a rerun file without a screen and save what the viewer shows as a PNG.

    python tools/screenshot.py run.rrd out.png --time env_step=40 --size 1600x900

Needs a Vulkan driver; a software one will do (`apt-get install mesa-vulkan-drivers`). The viewer listens on 127.0.0.1
only, keeps no settings, and is stopped at the end. Exit codes: 0 saved, 2 something to mend (the message says what).
What the viewer warns about is printed, and does not change the exit code.
"""

import argparse
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from PIL import Image
from rerun.experimental import Recording, ViewerClient

START_SECONDS, LOAD_SECONDS = 40.0, 120.0
SETTLE_SECONDS = 6.0  # until the viewer's notices are gone
TITLE_BAR = 36  # [pixel] that the viewer keeps above everything
EXPECTED = "Software rasterizer detected"
NO_DRIVER = "No Vulkan driver: `apt-get install mesa-vulkan-drivers` brings one that needs no graphics card."


class ScreenshotError(Exception):
    """Something a user can mend; the message says what."""


def screenshot(
    rrd: Path,
    png: Path,
    *,
    at: tuple[str, str] | None = None,
    size: tuple[int, int] = (1600, 900),
    settle: float = SETTLE_SECONDS,
) -> list[str]:
    """Save a picture of a rerun file; return what the viewer warned about.

    Args:
        rrd: The recording.
        png: Where the picture goes; replaced if it is there.
        at: Timeline and time, such as ("env_step", "40"); None: where the viewer starts.
        size: Width and height, [pixel].
        settle: [s] to wait before the picture is taken; the viewer's own notices stay for a few.

    Raises:
        ScreenshotError: If the file, the time, the driver or the target is not there or not usable.
    """
    if not png.parent.is_dir():
        raise ScreenshotError(f"The folder {png.parent} does not exist.")
    with open_viewer(rrd, size=(size[0], size[1] + TITLE_BAR)) as client:
        client.set_time(play_state="paused")
        if at is not None:
            set_time(client, *at)
        shown = client.get_blueprint().blueprint | {"/top_panel": {"PanelBlueprint": {"state": "Hidden"}}}
        client.set_blueprint(shown, of="recording")
        time.sleep(settle)
        with tempfile.TemporaryDirectory() as folder:
            shot = Path(folder) / "shot.png"
            client.save_screenshot(str(shot))
            with Image.open(shot) as picture:
                picture = picture.crop((0, TITLE_BAR, size[0], TITLE_BAR + size[1])).convert("RGB")
        warnings = reports(client)
    try:
        picture.save(png, format="png")
    except OSError as error:
        raise ScreenshotError(f"Cannot write {png}: {error.strerror}.") from error
    return warnings


@contextmanager
def open_viewer(rrd: Path, *, size: tuple[int, int] = (1600, 900)) -> Iterator[ViewerClient]:
    """A headless viewer that has loaded one file; gone when the block ends.

    Raises:
        ScreenshotError: If the file cannot be opened or the viewer does not start.
    """
    if not rrd.is_file():
        raise ScreenshotError(f"There is no file {rrd}.")
    with tempfile.TemporaryDirectory() as home:
        port = _free_port()
        log = Path(home) / "viewer.log"
        command = [sys.executable, "-m", "rerun_cli", "--headless", "--hide-welcome-screen", "--bind", "127.0.0.1"]
        command += ["--port", str(port), "--window-size", f"{size[0]}x{size[1]}"]
        own = {"RERUN_APP_ONLY": "true", "XDG_DATA_HOME": home, "XDG_CONFIG_HOME": home, "XDG_CACHE_HOME": home}
        with log.open("wb") as output:
            process = subprocess.Popen(
                command, env=os.environ | own, stdout=output, stderr=output, start_new_session=True
            )
        try:
            _wait_for_port(process, port, log)
            client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
            _wait_for_viewer(client, process, log)
            _load(client, rrd)
            yield client
        except (ConnectionError, RuntimeError, TimeoutError) as error:
            raise ScreenshotError(_last_words(log)) from error
        finally:
            _stop(process)


def set_time(client: ViewerClient, timeline: str, text: str) -> None:
    """Move the time cursor.

    Raises:
        ScreenshotError: If the recording has no such timeline or no such time.
    """
    timelines = {t.name: t for t in _recording(client).timelines}
    if timeline not in timelines:
        raise ScreenshotError(f"No timeline {timeline!r}. The recording has {sorted(timelines)}.")
    known = timelines[timeline]
    if known.time_type != "sequence":
        raise ScreenshotError(f"The timeline {timeline!r} counts in {known.time_type}, only sequences can be set here.")
    if not re.fullmatch(r"-?\d+", text) or not (known.start or 0) <= int(text) <= (known.end or 0):
        raise ScreenshotError(f"{timeline}={text} is not a whole number from {known.start} to {known.end}.")
    client.set_time(timeline, sequence=int(text), play_state="paused")


def reports(client: ViewerClient) -> list[str]:
    """Warnings and errors of the views and of the viewer's log, but for the one about a missing graphics card."""
    views = client.get_state().views
    found = [f"view {view.name!r}: {r.summary} {r.details or ''}".strip() for view in views for r in view.reports]
    logs = [entry for entry in client.get_logs() if entry.level in ("WARN", "ERROR") and EXPECTED not in entry.message]
    return found + [f"{entry.level} {entry.target}: {entry.message}" for entry in logs]


def _wait_for_viewer(client: ViewerClient, process: subprocess.Popen[bytes], log: Path) -> None:
    """Until it draws: its port opens before it finds out whether it can."""
    deadline = time.monotonic() + LOAD_SECONDS
    while process.poll() is None and time.monotonic() < deadline:
        try:
            client.get_state()
            return
        except TimeoutError:  # on a busy machine it takes a while
            time.sleep(0.1)
    raise ScreenshotError(_last_words(log))


def _load(client: ViewerClient, rrd: Path) -> None:
    deadline = time.monotonic() + LOAD_SECONDS
    try:
        client.open(str(rrd.resolve()))
    except (RuntimeError, TimeoutError) as error:
        raise ScreenshotError(f"The viewer cannot open {rrd}: {error}") from error
    while client.get_state().loading:
        if time.monotonic() > deadline:
            raise ScreenshotError(f"{rrd} was still loading after {LOAD_SECONDS:.0f} s.")
        time.sleep(0.1)
    _recording(client)


def _recording(client: ViewerClient) -> Recording:
    state = client.get_state()
    for recording in state.recordings:
        if recording.store_id == state.active_recording:
            return recording
    raise ScreenshotError("; ".join(["The viewer shows no recording", *reports(client)]))


def _wait_for_port(process: subprocess.Popen[bytes], port: int, log: Path) -> None:
    deadline = time.monotonic() + START_SECONDS
    while time.monotonic() < deadline and process.poll() is None:
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return
        time.sleep(0.05)
    raise ScreenshotError(_last_words(log))


def _last_words(log: Path) -> str:
    text = log.read_text(errors="replace")
    return NO_DRIVER if "adapter" in text else f"The rerun viewer stopped or did not start. It said: {text[-800:]}"


def _stop(process: subprocess.Popen[bytes]) -> None:
    """End the launcher and the viewer below it, which share a process group of their own."""
    for kind in (signal.SIGTERM, signal.SIGKILL):
        try:
            os.killpg(process.pid, kind)
            process.wait(timeout=5)
        except ProcessLookupError:
            break
        except subprocess.TimeoutExpired:
            continue
    process.wait()


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def _pair(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not (name and equals and value):
        raise argparse.ArgumentTypeError(f"{text!r} is not timeline=time, such as env_step=40")
    return name, value


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d{2,5})x(\d{2,5})", text)
    if match is None:
        raise argparse.ArgumentTypeError(f"{text!r} is not widthxheight in pixels, such as 1600x900")
    return int(match[1]), int(match[2])


def main(arguments: list[str] | None = None) -> int:
    assert __doc__ is not None
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0], allow_abbrev=False)
    parser.add_argument("rrd", type=Path, help="recording to open")
    parser.add_argument("png", type=Path, help="picture to write")
    parser.add_argument("--time", type=_pair, metavar="TIMELINE=TIME", help="where to look, such as env_step=40")
    parser.add_argument("--size", type=_size, default=(1600, 900), metavar="WxH", help="in pixels (1600x900)")
    options = parser.parse_args(arguments)
    try:
        warnings = screenshot(options.rrd, options.png, at=options.time, size=options.size)
    except ScreenshotError as error:
        print(f"screenshot: {error}", file=sys.stderr)
        return 2
    for line in warnings:
        print(f"warning of the viewer: {line}", file=sys.stderr)
    print(options.png)
    return 0


if __name__ == "__main__":
    sys.exit(main())
