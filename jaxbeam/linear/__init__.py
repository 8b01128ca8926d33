"""Linear algebra of Newton's method. It uses the topology of a scene, not its physics.

`BlockTridiagonal` is the default. `Newton(linear=Dense())` is for tiny scenes, and to check the default against.
"""
