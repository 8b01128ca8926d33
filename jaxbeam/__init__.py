"""A differentiable simulator of soft beams steered by contractile tendons.

    scene = jb.tendon_beam()                        # make a beam,
    pulled = jb.command(scene, [0.4, 1.0])          # pull a tendon,
    solution = jb.check(jb.equilibrium(pulled))     # solve, and refuse what is not right,
    angle = jb.tip_angle(pulled, solution.x)        # read the answer

All public names, by task. `help(jb.reach)` says all about one. The gallery `examples/README.md`
shows what can be done.

Make a beam
  tendon_beam               the reference beam of triangles, with two tendons
  rod_beam                  the same as a rod: cheaper, and less exact
  Scene                     a scene of your own: a mesh, terms, what is fixed, the tip

Bodies of other shapes
  rectangle                 mesh of a rectangle, uniform or graded
  mapped                    a mesh moved to another shape, such as a taper or a bend
  without                   a mesh without some elements: holes and chambers
  joined                    several bodies in one mesh, such as two fingers
  Mesh                      a mesh of your own nodes and triangles
  quadratic                 six nodes in each triangle in place of three
  refined                   each triangle cut into four
  nodes_where               nodes by a condition on x and y
  nearest_node              the node nearest to a point, or to each of many
  elements_where            elements by a condition on x and y
  side                      nodes along the surface, from one node to another
  along                     nodes of a line at given distances: guides
  arc_lengths               distances along a line of nodes
  surface_lines             the closed lines that bound a body and its holes

Materials
  solid                     the elastic body: a mesh, parameters and a density
  lame                      parameters from Young's modulus and Poisson's ratio
  lame_macklin_mueller      the same for `macklin_mueller`, right at small strain
  macklin_mueller           neo-Hookean, finite for inverted elements; the default
  neo_hookean               neo-Hookean, exact at small strain, for J > 0 only
  saint_venant_kirchhoff    for large rotations at small strains
  linear_elastic            for small rotations and small strains

Tendons and other actuators
  tendons                   springs along lines through guides; they pull and push
  cables                    the same, but they only pull
  pulls                     cables under a tension that is commanded
  pressure                  pressure in a chamber or on a side, also commanded
  support                   nodes that are moved by a command, such as by a grip
  constant_stiffness        law of a tendon: stiffness as given
  inverse_stiffness         law of a tendon: EA over its commanded length
  inverse_square_stiffness  law of a tendon: that of the reference beam
  command                   the scene under new commands

Loads, contact and supports
  dead_load                 forces on nodes
  traction                  force on edges of the surface
  weight                    force on all area, such as gravity
  contact                   a rigid obstacle that the surface may touch
  half_plane                an obstacle: a floor or a wall
  disk                      an obstacle: a disk
  box                       an obstacle: a rectangle
  clamped                   nodes that do not move
  penalty_springs           nodes held by springs: a soft clamp

Physics of your own
  Term                      an energy, its nodes and parameters; a function is enough
  Energy                    an energy that is also commanded, ramped, drawn, refined
  NotRefinable              raised by an energy without a form on a finer mesh

Solve
  equilibrium               one command
  ramp                      the way to a command in steps, as if pulled slowly
  commands                  the commands of such a ramp
  sweep                     many commands, on all cores
  linear_response           one linear solve, for small deflections
  Newton                    settings of the solver
  BlockTridiagonal          its linear solver
  Dense                     its linear solver for tiny scenes

Read the answer
  tip_angle                 deflection of the tip, degrees
  tip_position              mean position of the tip
  section_rotation          turn of the tip section, degrees
  marker                    position of any point of the body
  curvature                 curvature along a line of nodes
  tendon_lengths            present lengths of tendons
  tendon_tensions           forces of tendons
  tendon_slack              which cables are slack
  guide_forces              forces of tendons on the body at ends and guides
  contact_forces            forces of obstacles on edges
  contact_pressures         largest pressure on each edge
  penetration               how deep edges have sunk into obstacles
  reactions                 forces of clamps and supports
  forces                    forces of all terms on nodes
  energy                    energy of all terms
  strain_energy             elastic energy of each element
  cauchy_stress             stress in the plane, of each element
  nodal_stress              stress in the plane, at nodes: smoother
  nodal_von_mises_stress    von Mises stress at nodes
  to_nodes                  values of elements carried to the nodes
  strain_energy_density     elastic energy by area, of each element
  out_of_plane_stress       stress across the plane, of each element
  von_mises_stress          von Mises stress of each element
  principal_stretches       principal stretches of each element
  jacobians                 J, the change of area, of each element
  smallest_jacobian         smallest J anywhere in the body

Is it right?
  check                     raises for an answer that cannot be trusted, says why
  Status                    flags of what is wrong with a solution
  EquilibriumError          the error that `check` raises
  lowest_mode               how stable: lowest eigenvalues and their shapes
  trace_branch              where it snaps: a branch through its folds
  estimate_error            error bar of a measure: what the mesh leaves
  model_doubt               what speaks against the model of a rod

Choose speed against accuracy
  choose                    the cheapest way to solve the tendon beam to an error
  euler_bernoulli           the tendon beam by hand
  two_meshes                a scene on its mesh and a finer one, for `corrected`
  corrected                 a measure with an error bar, for one or many commands
  solve_to                  refine until a measure is within a tolerance
  enriched                  a scene on a finer mesh

Design
  reach                     commands that bring a measure to a target
  reach_each                the same for a sequence of targets, such as a path
  minimise                  any loss of any design: shape, material, commands

Fit to measurements
  fit                       parameters of a design by least squares, and what is known of them
  predict                   a measure under new commands, with its standard error
  next_experiment           which commands are best measured next

Pictures and files, imported by themselves
  jaxbeam.plot              stills, curves, animations, and a window to play in
  jaxbeam.files             meshes in; results for ParaView and tables out; archives

Types of what comes back
  Solution                  of `equilibrium`, `ramp` and `sweep`
  Design                    of `reach`, `reach_each` and `minimise`
  DesignStatus              how a design ended
  History                   the trials of a design
  Modes                     of `lowest_mode`
  Branch                    of `trace_branch`
  Critical                  a fold or a bifurcation on a branch
  ErrorEstimate             of `estimate_error`
  Fit                       of `fit`
  Prediction                of `predict`
  Experiments               of `next_experiment`
  Answer                    of `solve_to`
  TwoMeshes                 of `two_meshes`
  Corrected                 of `corrected`
  Doubt                     flags of why `corrected` knows no error bar
  Choice                    of `choose`
  Lame                      of `lame`
  Marker                    of `marker`
  Obstacle                  of `half_plane`, `disk` and `box`, or your own

`jaxbeam.plot` needs matplotlib, and `jaxbeam.files` needs meshio for meshes and for ParaView.
Each folder is a room. Read them in the order core, mesh, physics, scene, linear, solve, study:
a room imports only from rooms before it. `help(jb.solve)` and so on say when to use what is in it.
"""

from types import ModuleType as _ModuleType

from jaxbeam.linear.dense import Dense as Dense
from jaxbeam.linear.tridiagonal import BlockTridiagonal as BlockTridiagonal
from jaxbeam.mesh.bodies import joined as joined
from jaxbeam.mesh.bodies import mapped as mapped
from jaxbeam.mesh.bodies import without as without
from jaxbeam.mesh.mesh import Mesh as Mesh
from jaxbeam.mesh.mesh import elements_where as elements_where
from jaxbeam.mesh.mesh import nearest_node as nearest_node
from jaxbeam.mesh.mesh import nodes_where as nodes_where
from jaxbeam.mesh.rectangle import rectangle as rectangle
from jaxbeam.mesh.refinement import quadratic as quadratic
from jaxbeam.mesh.refinement import refined as refined
from jaxbeam.mesh.sides import along as along
from jaxbeam.mesh.sides import arc_lengths as arc_lengths
from jaxbeam.mesh.sides import side as side
from jaxbeam.mesh.sides import surface_lines as surface_lines
from jaxbeam.physics.cable import cables as cables
from jaxbeam.physics.contact import Obstacle as Obstacle
from jaxbeam.physics.contact import box as box
from jaxbeam.physics.contact import contact as contact
from jaxbeam.physics.contact import disk as disk
from jaxbeam.physics.contact import half_plane as half_plane
from jaxbeam.physics.distributed_load import traction as traction
from jaxbeam.physics.distributed_load import weight as weight
from jaxbeam.physics.energy import Energy as Energy
from jaxbeam.physics.energy import NotRefinable as NotRefinable
from jaxbeam.physics.energy import Term as Term
from jaxbeam.physics.load import dead_load as dead_load
from jaxbeam.physics.materials import Lame as Lame
from jaxbeam.physics.materials import lame as lame
from jaxbeam.physics.materials import lame_macklin_mueller as lame_macklin_mueller
from jaxbeam.physics.materials import linear_elastic as linear_elastic
from jaxbeam.physics.materials import macklin_mueller as macklin_mueller
from jaxbeam.physics.materials import neo_hookean as neo_hookean
from jaxbeam.physics.materials import saint_venant_kirchhoff as saint_venant_kirchhoff
from jaxbeam.physics.pressure import pressure as pressure
from jaxbeam.physics.pull import pulls as pulls
from jaxbeam.physics.solid import solid as solid
from jaxbeam.physics.spring import penalty_springs as penalty_springs
from jaxbeam.physics.support import support as support
from jaxbeam.physics.tendon import constant_stiffness as constant_stiffness
from jaxbeam.physics.tendon import inverse_square_stiffness as inverse_square_stiffness
from jaxbeam.physics.tendon import inverse_stiffness as inverse_stiffness
from jaxbeam.physics.tendon import tendons as tendons
from jaxbeam.scene.beams import rod_beam as rod_beam
from jaxbeam.scene.beams import tendon_beam as tendon_beam
from jaxbeam.scene.evaluation import energy as energy
from jaxbeam.scene.evaluation import forces as forces
from jaxbeam.scene.evaluation import reactions as reactions
from jaxbeam.scene.evaluation import smallest_jacobian as smallest_jacobian
from jaxbeam.scene.measures import cauchy_stress as cauchy_stress
from jaxbeam.scene.measures import contact_forces as contact_forces
from jaxbeam.scene.measures import contact_pressures as contact_pressures
from jaxbeam.scene.measures import guide_forces as guide_forces
from jaxbeam.scene.measures import jacobians as jacobians
from jaxbeam.scene.measures import penetration as penetration
from jaxbeam.scene.measures import section_rotation as section_rotation
from jaxbeam.scene.measures import strain_energy as strain_energy
from jaxbeam.scene.measures import tendon_lengths as tendon_lengths
from jaxbeam.scene.measures import tendon_slack as tendon_slack
from jaxbeam.scene.measures import tendon_tensions as tendon_tensions
from jaxbeam.scene.measures import tip_angle as tip_angle
from jaxbeam.scene.measures import tip_position as tip_position
from jaxbeam.scene.nodal import nodal_stress as nodal_stress
from jaxbeam.scene.nodal import nodal_von_mises_stress as nodal_von_mises_stress
from jaxbeam.scene.nodal import to_nodes as to_nodes
from jaxbeam.scene.points import Marker as Marker
from jaxbeam.scene.points import curvature as curvature
from jaxbeam.scene.points import marker as marker
from jaxbeam.scene.scene import Scene as Scene
from jaxbeam.scene.scene import clamped as clamped
from jaxbeam.scene.scene import command as command
from jaxbeam.scene.stress import out_of_plane_stress as out_of_plane_stress
from jaxbeam.scene.stress import principal_stretches as principal_stretches
from jaxbeam.scene.stress import strain_energy_density as strain_energy_density
from jaxbeam.scene.stress import von_mises_stress as von_mises_stress
from jaxbeam.solve.equilibrium import equilibrium as equilibrium
from jaxbeam.solve.equilibrium import linear_response as linear_response
from jaxbeam.solve.newton import Newton as Newton
from jaxbeam.solve.ramp import commands as commands
from jaxbeam.solve.ramp import ramp as ramp
from jaxbeam.solve.solution import EquilibriumError as EquilibriumError
from jaxbeam.solve.solution import Solution as Solution
from jaxbeam.solve.solution import Status as Status
from jaxbeam.solve.solution import check as check
from jaxbeam.solve.sweep import sweep as sweep
from jaxbeam.study.accuracy import Answer as Answer
from jaxbeam.study.accuracy import ErrorEstimate as ErrorEstimate
from jaxbeam.study.accuracy import enriched as enriched
from jaxbeam.study.accuracy import estimate_error as estimate_error
from jaxbeam.study.accuracy import solve_to as solve_to
from jaxbeam.study.branch import Branch as Branch
from jaxbeam.study.branch import Critical as Critical
from jaxbeam.study.branch import trace_branch as trace_branch
from jaxbeam.study.by_hand import euler_bernoulli as euler_bernoulli
from jaxbeam.study.choice import Choice as Choice
from jaxbeam.study.choice import choose as choose
from jaxbeam.study.corrected import Corrected as Corrected
from jaxbeam.study.corrected import corrected as corrected
from jaxbeam.study.design import Design as Design
from jaxbeam.study.design import DesignStatus as DesignStatus
from jaxbeam.study.design import History as History
from jaxbeam.study.doubt import Doubt as Doubt
from jaxbeam.study.experiments import Experiments as Experiments
from jaxbeam.study.experiments import Prediction as Prediction
from jaxbeam.study.experiments import next_experiment as next_experiment
from jaxbeam.study.experiments import predict as predict
from jaxbeam.study.fit import Fit as Fit
from jaxbeam.study.fit import fit as fit
from jaxbeam.study.minimise import minimise as minimise
from jaxbeam.study.model_doubt import model_doubt as model_doubt
from jaxbeam.study.reach import reach as reach
from jaxbeam.study.reach import reach_each as reach_each
from jaxbeam.study.stability import Modes as Modes
from jaxbeam.study.stability import lowest_mode as lowest_mode
from jaxbeam.study.two_meshes import TwoMeshes as TwoMeshes
from jaxbeam.study.two_meshes import two_meshes as two_meshes

__version__ = "0.1.0"

# The names imported above. Those imports also make the rooms attributes of this module: they are left out.
__all__ = sorted(name for name, value in globals().items() if name[0] != "_" and not isinstance(value, _ModuleType))


def __dir__() -> list[str]:
    return list(__all__)
