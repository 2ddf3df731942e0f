"""Checkpoints come back as they were, or say what is wrong; a failed write leaves the earlier file."""

import errno
import os

import pytest
import torch
from omegaconf import OmegaConf

from mpc_sgft.learning.buffer import make_buffer
from mpc_sgft.learning.world_model import WorldModel
from mpc_sgft.storage import checkpoint
from mpc_sgft.storage.checkpoint import CheckpointError

SIZES = dict(obs_dim=6, action_dim=2, decode_dim=3, latent_dim=16, mlp_dim=32, enc_dim=32, num_q=2)
CFG = OmegaConf.create({"chosen": {"task": "push"}, "task": {"history": 2, "discount": 0.99}, "train": {"lr": 3e-4}})


def saved(path, residual=False, band=False):
    torch.manual_seed(0)
    model = WorldModel(**SIZES)
    model.normalizer.update(torch.randn(20, 6))
    model.value_range = 2.5
    if residual:
        model.add_residual()
        torch.nn.init.normal_(model.dynamics.residual[-1].weight)
    if band:
        model.add_command_map()
        torch.nn.init.uniform_(model.add_command_band().band)
        model.use_band(True)
        model.add_observation_map([[0, 1]])
        model.add_suspicion()
        model.suspect(True)
    checkpoint.save(path, model, checkpoint.describe(CFG, model, extra={"transitions": 7}))
    return model


@pytest.mark.parametrize(("residual", "band"), [(False, False), (True, False), (False, True)])
def test_a_model_comes_back_bit_for_bit_with_its_header(tmp_path, residual, band):
    model = saved(tmp_path / "model.safetensors", residual, band)
    loaded, meta = checkpoint.load(tmp_path / "model.safetensors", tasks=["edge", "push"], sizes={"obs_dim": 6})
    for (name, a), (other, b) in zip(model.state_dict().items(), loaded.state_dict().items(), strict=True):
        assert name == other and torch.equal(a, b)
    observation, action = torch.randn(4, 6), torch.zeros(4, 2)
    assert torch.equal(model.next(model.encode(observation), action), loaded.next(loaded.encode(observation), action))
    assert (meta["task"], meta["history"], meta["discount"], meta["transitions"]) == ("push", 2, 0.99, 7)
    assert meta["config"]["train"]["lr"] == 3e-4
    assert loaded.value_range == 2.5


def test_a_header_does_not_say_where_it_was_made(tmp_path):
    here = {"run_dir": "/home/me/run", "overrides": ["seed=3", "run_dir=/home/me/run"]}
    model = saved(tmp_path / "model.safetensors")
    config = checkpoint.describe(OmegaConf.merge(CFG, here), model)["config"]
    assert config["overrides"] == ["seed=3"] and "/home/me" not in str(config)


def test_a_header_of_before_keeps_the_temperature_of_before(tmp_path):
    model = saved(tmp_path / "new.safetensors")
    header = checkpoint.describe(CFG, model)
    del header["value_range"]
    checkpoint.save(tmp_path / "old.safetensors", model, header)
    assert 0.1 * checkpoint.load(tmp_path / "old.safetensors").model.value_range == 2.0


def test_an_observation_map_of_before_suspects_nothing(tmp_path):
    model = WorldModel(**SIZES)
    model.add_observation_map([[0, 1]])
    model.observation_map.doubted.fill_(1.0)
    torch.nn.init.normal_(model.observation_map.shift)
    header = checkpoint.describe(CFG, model)
    seen = torch.randn(3, 6)
    wanted = model.encode(seen)
    del header["suspicion"], model.observation_map._buffers["suspects"]
    checkpoint.save(tmp_path / "old.safetensors", model, header)
    loaded = checkpoint.load(tmp_path / "old.safetensors").model
    assert not loaded.observation_map.suspects and torch.equal(loaded.encode(seen), wanted)


def test_a_run_folder_stands_for_the_file_inside(tmp_path):
    saved(tmp_path / checkpoint.WEIGHTS)
    assert checkpoint.load(tmp_path).meta["task"] == "push"


@pytest.mark.parametrize(
    ("wanted", "message"),
    [
        ({"tasks": ["pendulum", "cart"]}, "expected task='pendulum', found task='push'"),
        ({"sizes": {"obs_dim": 9}}, "expected obs_dim=9, found obs_dim=6"),
        ({"sizes": {"latent_dim": 512}}, "expected latent_dim=512, found latent_dim=16"),
    ],
)
def test_wrong_task_and_size_say_file_expected_and_found(tmp_path, wanted, message):
    saved(tmp_path / "model.safetensors")
    with pytest.raises(CheckpointError, match=message) as caught:
        checkpoint.load(tmp_path / "model.safetensors", **wanted)
    assert "model.safetensors" in str(caught.value)


@pytest.mark.parametrize("position", [3, 40, -1, -3000])
def test_a_flipped_bit_anywhere_is_noticed(tmp_path, position):
    path = tmp_path / "model.safetensors"
    saved(path)
    flip(path, position)
    with pytest.raises(CheckpointError, match="model.safetensors"):
        checkpoint.load(path)


@pytest.mark.parametrize("content", [b"", b"not a checkpoint at all", None])
def test_foreign_and_cut_files_are_refused(tmp_path, content):
    path = tmp_path / "model.safetensors"
    saved(path)
    path.write_bytes(path.read_bytes()[:5000] if content is None else content)
    with pytest.raises(CheckpointError, match="corrupt"):
        checkpoint.load(path)


def test_safetensors_of_someone_else_and_missing_files(tmp_path):
    import safetensors.torch

    safetensors.torch.save_file({"x": torch.zeros(3)}, tmp_path / "other.safetensors")
    with pytest.raises(CheckpointError, match="not written by mpc_sgft"):
        checkpoint.load(tmp_path / "other.safetensors")
    with pytest.raises(CheckpointError, match="No checkpoint"):
        checkpoint.load(tmp_path / "nothing")
    with pytest.raises(CheckpointError, match="No checkpoint at .*/checkpoint/model.safetensors"):
        checkpoint.load(tmp_path)
    with pytest.raises(CheckpointError, match="No saved state"):
        checkpoint.load_state(tmp_path / "nothing")


def test_a_file_that_may_not_be_read_is_not_called_corrupt(tmp_path, monkeypatch):
    def refused(file, *rest):
        raise PermissionError(errno.EACCES, "Permission denied", str(file))

    saved(tmp_path / "model.safetensors")
    checkpoint.save_state(tmp_path / "state.pt", {"round": 1})
    monkeypatch.setattr("builtins.open", refused)
    for name, load in (("model.safetensors", checkpoint.load), ("state.pt", checkpoint.load_state)):
        with pytest.raises(CheckpointError, match=f"{name} cannot be read: Permission denied. Make it readable"):
            load(tmp_path / name)


def test_state_comes_back_and_corruption_is_noticed(tmp_path):
    buffer = make_buffer(20, 2, 4, seed=3)
    state = {"loop": {"round": 3, "seconds": 1.5}, "buffer": buffer.state_dict(), "list": [torch.arange(3), (1, "a")]}
    path = tmp_path / "state.pt"
    checkpoint.save_state(path, state)
    back = checkpoint.load_state(path)
    assert back["loop"] == state["loop"] and torch.equal(back["list"][0], torch.arange(3))
    assert torch.equal(back["buffer"]["sampler"]["generator"], state["buffer"]["sampler"]["generator"])
    flip(path, 2000)
    with pytest.raises(CheckpointError, match="corrupt"):
        checkpoint.load_state(path)


@pytest.mark.parametrize("fails", ["write", "fsync", "replace"])
def test_a_failed_write_leaves_the_earlier_file_and_no_litter(tmp_path, monkeypatch, fails):
    path = tmp_path / "state.pt"
    checkpoint.save_state(path, {"round": 1})

    def full(*args, **kwargs):
        raise OSError(errno.ENOSPC, "No space left on device")

    if fails == "write":
        monkeypatch.setattr("builtins.open", full)
    else:
        monkeypatch.setattr(os, fails, full)
    with pytest.raises(OSError, match="state.pt") as caught:
        checkpoint.save_state(path, {"round": 2})
    monkeypatch.undo()
    assert caught.value.errno == errno.ENOSPC
    assert checkpoint.load_state(path) == {"round": 1}
    assert [p.name for p in tmp_path.iterdir()] == ["state.pt"]


def flip(path, position):
    data = bytearray(path.read_bytes())
    data[position] ^= 1
    path.write_bytes(data)
