"""Energies: the interface, the materials, and one file for each kind of energy.

The body of triangles is a `solid`. What pulls on it:

- `tendons` are springs, and push where they are too long; `cables` go slack instead;
- `pulls` are for a motor or a weight that sets the tension, `tendons` and `cables` for one that sets the length.

What presses on it and what holds it:

- `pressure` stays normal to the surface as it turns and is commanded; `traction` keeps its direction and is constant;
- `dead_load` acts on nodes, and displacements there have no limit as the mesh is refined; `traction` spreads out;
- `Scene.fixed` for what never moves, `support` for what a command moves, `contact` for an obstacle that may be touched.

Anything else is a `Term` of your own: a bare function where its energy is all there is to it, and an `Energy` where it
is also to be commanded, ramped, drawn or refined.
"""
