"""jaxbeam: a differentiable simulator of soft beams steered by contractile tendons.

Read it in order: elements -> mesh -> materials -> terms -> scene -> equilibrium -> actuation -> sweep -> measures ->
design -> accuracy.
Pictures are in `jaxbeam.plot`, which is imported by itself because it needs matplotlib.
"""

from jaxbeam.accuracy import Answer as Answer
from jaxbeam.accuracy import ErrorEstimate as ErrorEstimate
from jaxbeam.accuracy import enriched as enriched
from jaxbeam.accuracy import estimate_error as estimate_error
from jaxbeam.accuracy import solve_to as solve_to
from jaxbeam.actuation import commands as commands
from jaxbeam.actuation import ramp as ramp
from jaxbeam.branch import Branch as Branch
from jaxbeam.branch import Critical as Critical
from jaxbeam.branch import trace_branch as trace_branch
from jaxbeam.design import Design as Design
from jaxbeam.design import DesignStatus as DesignStatus
from jaxbeam.design import History as History
from jaxbeam.design import minimise as minimise
from jaxbeam.design import reach as reach
from jaxbeam.design import reach_each as reach_each
from jaxbeam.dissection import Automatic as Automatic
from jaxbeam.dissection import NestedDissection as NestedDissection
from jaxbeam.equilibrium import equilibrium as equilibrium
from jaxbeam.equilibrium import linear_response as linear_response
from jaxbeam.linear import BlockTridiagonal as BlockTridiagonal
from jaxbeam.linear import Dense as Dense
from jaxbeam.materials import Lame as Lame
from jaxbeam.materials import lame as lame
from jaxbeam.materials import lame_macklin_mueller as lame_macklin_mueller
from jaxbeam.materials import linear_elastic as linear_elastic
from jaxbeam.materials import macklin_mueller as macklin_mueller
from jaxbeam.materials import neo_hookean as neo_hookean
from jaxbeam.materials import saint_venant_kirchhoff as saint_venant_kirchhoff
from jaxbeam.measures import cauchy_stress as cauchy_stress
from jaxbeam.measures import jacobians as jacobians
from jaxbeam.measures import nodal_stress as nodal_stress
from jaxbeam.measures import section_rotation as section_rotation
from jaxbeam.measures import strain_energy as strain_energy
from jaxbeam.measures import tendon_lengths as tendon_lengths
from jaxbeam.measures import tendon_tensions as tendon_tensions
from jaxbeam.measures import tip_angle as tip_angle
from jaxbeam.measures import tip_position as tip_position
from jaxbeam.mesh import Mesh as Mesh
from jaxbeam.mesh import nearest_node as nearest_node
from jaxbeam.mesh import nodes_where as nodes_where
from jaxbeam.mesh import quadratic as quadratic
from jaxbeam.mesh import rectangle as rectangle
from jaxbeam.mesh import refined as refined
from jaxbeam.newton import Newton as Newton
from jaxbeam.rod import euler_bernoulli as euler_bernoulli
from jaxbeam.scene import Scene as Scene
from jaxbeam.scene import clamped as clamped
from jaxbeam.scene import command as command
from jaxbeam.scene import energy as energy
from jaxbeam.scene import forces as forces
from jaxbeam.scene import reactions as reactions
from jaxbeam.scene import rod_beam as rod_beam
from jaxbeam.scene import smallest_jacobian as smallest_jacobian
from jaxbeam.scene import tendon_beam as tendon_beam
from jaxbeam.solution import EquilibriumError as EquilibriumError
from jaxbeam.solution import Solution as Solution
from jaxbeam.solution import Status as Status
from jaxbeam.solution import check as check
from jaxbeam.stability import Modes as Modes
from jaxbeam.stability import lowest_mode as lowest_mode
from jaxbeam.sweep import sweep as sweep
from jaxbeam.terms import Term as Term
from jaxbeam.terms import constant_stiffness as constant_stiffness
from jaxbeam.terms import dead_load as dead_load
from jaxbeam.terms import inverse_square_stiffness as inverse_square_stiffness
from jaxbeam.terms import inverse_stiffness as inverse_stiffness
from jaxbeam.terms import penalty_springs as penalty_springs
from jaxbeam.terms import solid as solid
from jaxbeam.terms import tendons as tendons

__version__ = "0.1.0"
