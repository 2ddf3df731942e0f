"""Scripts that make what results/ holds."""
