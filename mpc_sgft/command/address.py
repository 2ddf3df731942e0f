"""Whether a Ray cluster answers where a run is to join one, asked before anything that takes seconds to import."""

from __future__ import annotations

import os
import socket

from omegaconf import DictConfig, OmegaConf

from mpc_sgft.command.errors import UserError

ANSWER = 4.0  # [s] within which a cluster must accept a connection, and speak
HELLO = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes([0, 0, 0, 4, 0, 0, 0, 0, 0])  # preface and settings, RFC 9113
SETTINGS = 4  # kind of the first frame that gRPC, as Ray speaks it, answers with


def check_address(cfg: DictConfig) -> None:
    """Refuse a `collector.address` where no cluster can be; Ray itself tries for longer than a minute.

    Raises:
        UserError: If it is no address, nobody answers there, or something that does not speak Ray's protocol.
    """
    address = OmegaConf.select(cfg, "collector.address")
    if address in (None, "auto"):
        return
    host, _, port = str(address).removeprefix("ray://").rpartition(":")
    if not host or not port.isdigit():
        raise UserError(f"collector.address={address}: host:port, ray://host:port or auto.")
    then = "Start a cluster there with ray start --head, or leave the address out to start one here."
    try:
        with socket.create_connection((host, int(port)), timeout=ANSWER) as connection:
            if os.environ.get("RAY_USE_TLS", "0") in ("0", "false"):  # else it waits for a certificate
                connection.sendall(HELLO)
                head = connection.recv(9)
                if len(head) < 4 or head[3] != SETTINGS:
                    raise UserError(f"collector.address={address}: something answers that is no Ray cluster. {then}")
    except TimeoutError as error:
        raise UserError(f"collector.address={address}: no answer within {ANSWER:.0f} s. {then}") from error
    except (OSError, OverflowError) as error:
        raise UserError(f"collector.address={address}: nobody answers ({error}). {then}") from error
