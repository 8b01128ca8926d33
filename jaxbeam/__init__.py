"""jaxbeam: a differentiable simulator of soft beams steered by contractile tendons.

Each folder is a room. Read them in the order core, mesh, physics, scene, linear, solve, study: a room imports only from
rooms before it. The names below are all that a user needs.
Pictures are in `jaxbeam.plot`, which is imported by itself because it needs matplotlib. Files are read and written by
`jaxbeam.files`, which is imported by itself too.
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
