"""Rounds on a real local Ray cluster: the same numbers, workers that are killed, and nothing left behind."""

from __future__ import annotations

import csv
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import psutil
import pytest

from mpc_sgft.command import compose
from mpc_sgft.command.errors import UserError
from mpc_sgft.runs import build, ray_collector
from mpc_sgft.runs.explore import Collected, Explorer, Round, joined, policy_weights
from mpc_sgft.runs.ray_collector import Ray

pytest.importorskip("ray", reason="needs Ray")
HEAD = (
    "import ray, sys\n"
    "ray.init(address='local', num_cpus=2, include_dashboard=False, object_store_memory=2**28, log_to_driver=False)\n"
    "print(ray.get_runtime_context().gcs_address, flush=True)\n"
    "sys.stdin.read()\n"
)
CFG = compose.compose("pretrain", ["task=pendulum", "+experiment=debug", "num_envs=5", "device=cpu"], [])


def workers_of(parent: psutil.Process) -> list[psutil.Process]:
    return [p for p in parent.children(recursive=True) if _name(p).startswith("ray::_Worker")]


def _name(process: psutil.Process) -> str:
    try:
        return process.name()
    except psutil.NoSuchProcess:  # it ended since it was listed
        return ""


@pytest.fixture(scope="module")
def agent():
    return build.make_agent(CFG, build.make_env(CFG, 1))


@pytest.fixture(scope="module")
def cluster(agent) -> Iterator[Ray]:
    collector = Ray(CFG, agent.model.sizes, workers=2)
    yield collector
    collector.close()
    assert not workers_of(psutil.Process())


@pytest.fixture(scope="module")
def expected(agent) -> Collected:
    order = Round(3, policy_weights(agent.model))
    return joined([Explorer(CFG, agent.model.sizes, part, 2).collect(order) for part in range(2)])


def test_a_cluster_collects_what_this_process_would(agent, cluster, expected) -> None:
    cluster.start(Round(3, policy_weights(agent.model)))
    assert (cluster.result().steps == expected.steps).all() and len(expected.steps) == 5
    assert cluster.result() is cluster.result()


def test_a_killed_worker_costs_its_share_and_nothing_else(agent, cluster, expected) -> None:
    victim = workers_of(psutil.Process())[0]
    cluster.start(Round(3, policy_weights(agent.model)))
    victim.kill()
    assert (cluster.result().steps == expected.steps).all()
    assert victim.pid not in {p.pid for p in workers_of(psutil.Process())}


def pretrain(*words: str, **more: str) -> subprocess.CompletedProcess[str]:
    line = [sys.executable, "-m", "mpc_sgft.pretrain", "--quiet", "task=pendulum", "+experiment=debug", *words]
    return subprocess.run(line, stderr=subprocess.PIPE, text=True, env=os.environ | more, timeout=120, check=False)


@pytest.mark.parametrize("kind", ["closed", "full", "silent", "web", "somewhere"])
def test_an_address_without_a_cluster_is_one_line_soon(kind: str, tmp_path: Path) -> None:
    """Nobody listens, nobody accepts, nobody speaks, or somebody speaks something else."""
    says = {"closed": "nobody answers", "web": "something answers that is no Ray cluster", "somewhere": "host:port"}
    with socket.socket() as taken, ExitStack() as others:
        taken.bind(("127.0.0.1", 0))
        if kind in ("full", "silent"):
            taken.listen(0)
        for _ in range(3 if kind == "full" else 0):  # nobody accepts, and there is no more room to wait
            other = others.enter_context(socket.socket())
            other.setblocking(False)
            other.connect_ex(taken.getsockname())
        port = taken.getsockname()[1]
        if kind == "web":
            server = others.enter_context(HTTPServer(("127.0.0.1", 0), BaseHTTPRequestHandler))
            threading.Thread(target=server.serve_forever, daemon=True).start()
            others.callback(server.shutdown)
            port = server.server_address[1]
        address = "somewhere" if kind == "somewhere" else f"127.0.0.1:{port}"
        began = time.monotonic()
        done = pretrain("collector=ray", f"collector.address={address}", f"run_dir={tmp_path / 'r'}")
    assert done.returncode == 2 and done.stderr.count("\n") == 1, done.stderr
    assert f"collector.address={address}: {says.get(kind, 'no answer within 4 s')}" in done.stderr, done.stderr
    assert time.monotonic() - began < 15 and not (tmp_path / "r").exists()


@pytest.mark.slow
def test_a_cluster_that_lets_nobody_in_is_one_line(tmp_path: Path) -> None:
    token = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": "0" * 32}
    line = [sys.executable, "-c", HEAD]
    with subprocess.Popen(
        line, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=os.environ | token
    ) as head:
        assert head.stdin and head.stdout
        try:
            words = f"collector.address={head.stdout.readline().strip()}", f"run_dir={tmp_path / 'r'}"
            done = pretrain("collector=ray", *words, **token | {"RAY_AUTH_TOKEN": "1" * 32})
        finally:
            head.stdin.close()
    assert done.returncode == 2 and done.stderr.count("\n") == 1, done.stderr
    assert "Ray could not join that cluster" in done.stderr and "asks for a token" in done.stderr


def test_a_cluster_that_is_there_is_joined_and_left_as_it_was(tmp_path: Path) -> None:
    """A process of its own has the cluster, another one pretrains on it; the first one sees its workers come and go."""
    line, own = [sys.executable, "-c", HEAD], {k: v for k, v in os.environ.items() if k != "RAY_AUTH_MODE"}
    with subprocess.Popen(line, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=own) as head:
        assert head.stdin and head.stdout
        try:
            address = head.stdout.readline().strip()
            words = ["task=pendulum", "+experiment=debug", "collector=ray", f"collector.address={address}"]
            words += [f"run_dir={tmp_path / 'run'}", "log.tensorboard=false"]
            line = [sys.executable, "-m", "mpc_sgft.pretrain", "--quiet", *words]
            with subprocess.Popen(line, stderr=subprocess.PIPE, text=True, env=own) as run:
                deadline = time.monotonic() + 120
                while run.poll() is None and not workers_of(psutil.Process(head.pid)):
                    assert time.monotonic() < deadline
                    time.sleep(0.1)
                seen = run.poll() is None
                _, error = run.communicate(timeout=120)
            assert seen and run.returncode == 0, error
            assert head.poll() is None and not workers_of(psutil.Process(head.pid))
            more = ["collector.workers=3", f"run_dir={tmp_path / 'more'}"]  # than it has CPUs
            line = [word for word in line if not word.startswith("run_dir=")] + more
            done = subprocess.run(line, stderr=subprocess.PIPE, text=True, env=own, timeout=120, check=False)
            assert done.returncode == 2 and f"the cluster at {address} has 2 CPUs" in done.stderr, done.stderr
        finally:
            head.stdin.close()
        assert head.wait(timeout=60) == 0


def test_a_pretraining_that_loses_a_worker_learns_the_same(tmp_path: Path) -> None:
    """One worker is killed in the middle; every number is that of a run in processes of this machine."""
    words = ["task=pendulum", "+experiment=debug", "transitions=3000", "collector.workers=2", "log.tensorboard=false"]
    quiet = os.environ | {"OMP_NUM_THREADS": "1"}

    def start(kind: str) -> subprocess.Popen[str]:
        own = [f"collector={kind}", f"run_dir={tmp_path / kind}"]
        line = [sys.executable, "-m", "mpc_sgft.pretrain", "--quiet", *words, *own]
        return subprocess.Popen(line, stderr=subprocess.PIPE, text=True, env=quiet)

    with start("process") as expected:
        assert expected.wait(timeout=120) == 0
    metrics, deadline = tmp_path / "ray" / "metrics.csv", time.monotonic() + 120
    with start("ray") as run:
        while not (metrics.exists() and len(metrics.read_text().splitlines()) > 2):
            assert time.monotonic() < deadline and run.poll() is None
            time.sleep(0.05)
        workers_of(psutil.Process(run.pid))[0].kill()
        _, error = run.communicate(timeout=120)
        assert run.returncode == 0, error
    numbers = [_without_seconds(tmp_path / kind / "metrics.csv") for kind in ("process", "ray")]
    assert numbers[0] == numbers[1] and len(numbers[0]) > 3


def _without_seconds(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return [{name: text for name, text in row.items() if name != "seconds"} for row in csv.DictReader(file)]


def test_a_worker_of_another_version_is_named(cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray_collector, "versions", lambda: {"mpc_sgft": "9.9"})
    monkeypatch.setattr(cluster, "close", lambda: None)  # the other tests go on with it
    with pytest.raises(UserError, match="the worker on .* has .*'mpc_sgft': '0.* this process .*9.9"):
        cluster._check_versions()


def test_another_state_of_our_own_code_is_another_version(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for package in ray_collector.OURS:
        shutil.copytree(
            ray_collector.ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("*.safetensors")
        )
    before = ray_collector.versions()
    monkeypatch.setattr(ray_collector, "ROOT", tmp_path)
    assert ray_collector.versions() == before
    (tmp_path / "envs" / "task.py").write_text("# changed\n")
    assert ray_collector.versions() != before


def test_a_worker_that_cannot_start_is_one_line(cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    import ray

    class Broken:
        def versions(self) -> None:
            raise ImportError("no module of that name")

    monkeypatch.setattr(cluster, "close", lambda: None)
    monkeypatch.setattr(cluster, "_workers", [ray.remote(num_cpus=0)(Broken).remote()])
    with pytest.raises(UserError, match="a worker cannot start: .*no module of that name. Is mpc_sgft") as found:
        cluster._check_versions()
    assert "\n" not in str(found.value)


def test_ctrl_c_leaves_no_process_behind(tmp_path: Path) -> None:
    words = ["task=pendulum", "+experiment=debug", "collector=ray", "transitions=1000000", f"run_dir={tmp_path / 'r'}"]
    line = [sys.executable, "-m", "mpc_sgft.pretrain", "--quiet", *words, "log.tensorboard=false"]
    run = subprocess.Popen(line, stderr=subprocess.PIPE, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"})
    metrics, deadline = tmp_path / "r" / "metrics.csv", time.monotonic() + 120
    while not (metrics.exists() and len(metrics.read_text().splitlines()) > 2):
        assert time.monotonic() < deadline and run.poll() is None
        time.sleep(0.2)
    family = psutil.Process(run.pid).children(recursive=True)
    assert any(p.name().startswith("ray::_Worker") for p in family)
    run.send_signal(signal.SIGINT)
    _, error = run.communicate(timeout=60)
    assert run.returncode == 130 and "Go on: python -m mpc_sgft.pretrain --resume" in error
    _, alive = psutil.wait_procs(family, timeout=20)
    assert not alive
