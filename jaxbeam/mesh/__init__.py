"""Bodies at rest: elements, meshes of triangles, lines of rods, refinement, surfaces.

Which mesh to begin with:

- a beam: `tendon_beam` makes its own; `rectangle` is for a beam with other tendons, loads or supports;
- a rectangle in another shape: `mapped` for tapers, bends and bulges, `without` for holes, `joined` for several bodies;
- anything else: a file of a mesh generator by `jaxbeam.files.read_mesh`, or `Mesh` of your own nodes and triangles.

Nodes are chosen by a condition (`nodes_where`), by a place (`nearest_node`), or along the surface (`side`, `along`).
Triangles of six nodes (`order=2`, `quadratic`) cost less than those of three for the same error. Those of three lock as
Poisson's ratio nears 0.5.
"""
