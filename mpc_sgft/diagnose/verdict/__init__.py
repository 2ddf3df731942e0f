"""Which name is right, where and when it shows, and what follows: repair, next experiment."""
