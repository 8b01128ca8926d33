"""Linear algebra of Newton's method. It knows the topology of a scene, and nothing of its physics."""
