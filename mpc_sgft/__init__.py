"""Pretrain in randomised simulation, deploy with SGFT, diagnose the gap that is left."""

__version__ = "0.1.0"
