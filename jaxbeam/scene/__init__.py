"""Scenes, the reference scenes, measures, and checks of supports and of overlap.

Begin with `tendon_beam`, whose arguments cover other proportions, materials, tendons and shapes. Use `rod_beam` where a
few percent are enough and the beam is slender. Use `Scene` for any other body, tendons and loads.

A scene is not changed: `command` makes a new one under other commands. Measures take a scene and positions, so they
read any state: `tip_angle(scene, solution.x)`. For all states of a ramp or sweep, map them with `jax.vmap`.
"""
