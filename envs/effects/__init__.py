"""What reality has and the nominal simulator lacks: one file each effect."""

from envs.effects.base import Effect, available, load
from envs.effects.rotor import place_rotors
from envs.effects.stribeck_friction import bend_bristles, bristles

__all__ = ["Effect", "available", "bend_bristles", "bristles", "load", "place_rotors"]
