import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import psutil
import pytest
import rerun as rr
from PIL import Image

from tools.screenshot import NO_DRIVER, main, open_viewer, screenshot

ROOT = Path(__file__).parents[2]


@pytest.fixture
def rrd(tmp_path) -> Path:
    """A line of points whose colour goes from black to white over ten steps."""
    path = tmp_path / "run.rrd"
    recording = rr.RecordingStream("test")
    recording.set_log_time_enabled(False)
    recording.save(path, rr.blueprint.Blueprint(rr.blueprint.Spatial2DView(origin="/image"), auto_views=False))
    for step in range(10):
        recording.set_time("env_step", sequence=step)
        recording.log("image", rr.Image(np.full((40, 60, 3), 25 * step, np.uint8)))
    recording.disconnect()
    return path


def test_the_picture_has_the_size_and_the_time_asked_for(viewer_draws, rrd, tmp_path):
    middle = {}
    for step in (1, 9):
        png = tmp_path / f"{step}.png"
        assert screenshot(rrd, png, at=("env_step", str(step)), size=(640, 400), settle=1.0) == []
        picture = Image.open(png)
        assert picture.size == (640, 400)
        middle[step] = np.asarray(picture)[200, 150].mean()  # left of the viewer's own notices
    assert middle[9] - middle[1] > 150


def test_the_viewer_listens_on_loopback_only_and_is_gone_afterwards(viewer_draws, rrd):
    before = set(psutil.Process().children(recursive=True))  # this process may have others, of other tests
    with open_viewer(rrd):
        children = [p for p in psutil.Process().children(recursive=True) if p not in before]
        listening = [c.laddr.ip for p in children for c in p.net_connections() if c.status == psutil.CONN_LISTEN]
        assert listening and set(listening) == {"127.0.0.1"}
    gone, alive = psutil.wait_procs(children, timeout=10)
    assert not [p for p in alive if p.status() != psutil.STATUS_ZOMBIE]


def test_mistakes_get_one_clear_line_and_exit_code_2(viewer_draws, rrd, tmp_path, capsys):
    png = str(tmp_path / "out.png")
    junk = tmp_path / "junk.rrd"
    junk.write_text("no recording")
    cases = [
        ([str(tmp_path / "none.rrd"), png], "There is no file"),
        ([str(rrd), str(tmp_path / "nowhere" / "out.png")], "nowhere does not exist"),
        ([str(junk), png], "no recording"),
        ([str(rrd), png, "--time", "frame=3"], "The recording has ['env_step']"),
        ([str(rrd), png, "--time", "env_step=99"], "from 0 to 9"),
    ]
    for arguments, message in cases:
        assert main(arguments) == 2
        said = capsys.readouterr().err
        assert message in said and "Traceback" not in said
    for wrong in (["--time", "env_step"], ["--size", "big"]):
        with pytest.raises(SystemExit) as stopped:
            main([str(rrd), png, *wrong])
        assert stopped.value.code == 2
    assert not Path(png).exists()


def test_a_missing_driver_is_named(rrd, tmp_path):
    env = os.environ | {"VK_DRIVER_FILES": "/nonexistent", "LIBGL_DRIVERS_PATH": "/nonexistent"}
    command = [sys.executable, "tools/screenshot.py", str(rrd), str(tmp_path / "out.png")]
    result = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True, timeout=120)
    assert result.returncode == 2 and NO_DRIVER in result.stderr and "Traceback" not in result.stderr
