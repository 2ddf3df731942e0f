"""How small the counts of the commands may be, so that a slip is said at once and not after an hour."""

from omegaconf import DictConfig, OmegaConf

from mpc_sgft.command.errors import UserError

FROM_ZERO = (
    *("seed", "eval_seed", "rollouts", "warmup"),
    *("min_transitions", "random_transitions", "imagined_steps", "hold_value"),
)
FROM_ONE = (
    *("episodes", "eval_every", "eval_episodes", "final_episodes", "save_every"),
    *("num_envs", "torch_threads", "transitions", "lr_halves_every", "target_streak"),
    *("train.replay.capacity", "train.replay.slice_len", "train.replay.batch_size", "method.slice_len"),
)
ABSENT = object()


def check_counts(cfg: DictConfig) -> None:
    """Refuse what is no whole number, or too small.

    Raises:
        UserError: Which one, and what it may be.
    """
    for least, keys in enumerate((FROM_ZERO, FROM_ONE)):
        for key in keys:
            value = OmegaConf.select(cfg, key, default=ABSENT)
            if value is ABSENT:  # of another command
                continue
            if isinstance(value, float) and value.is_integer():  # 1e6 in a sweep or a file
                value = int(value)
                OmegaConf.update(cfg, key, value)
            if not isinstance(value, int) or isinstance(value, bool) or value < least:
                raise UserError(f"{key}={value}: a whole number from {least} on is needed.")
