"""What reality has and the nominal simulator lacks: one file each effect."""

from envs.effects.backlash import place_rotors
from envs.effects.base import Effect, available, load

__all__ = ["Effect", "available", "load", "place_rotors"]
