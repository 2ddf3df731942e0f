"""Choosing by imagining: planners on plain tensors."""
