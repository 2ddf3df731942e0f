"""What may be missing: effects at places, their sizes, and which imitate one another."""
