"""Linear algebra of Newton's method. It uses the topology of a scene, not its physics."""
