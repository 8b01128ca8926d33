"""Pictures and animations of beams. Only this folder needs matplotlib, so it must be imported by name.

    path = jb.ramp(scene, [0.5, 1.0])
    states = plot.States(scene, path)
    plot.save_animation(plot.animate_ramp(states, field=jb.nodal_von_mises_stress), "ramp.gif")

One state
  Picture         a beam with all that holds it and acts on it, which can be moved
  Field           what to show in colour: a measure, its label and its colours
  beam, field     the axes of a picture, without and with a field

Many states
  States          the states of a ramp or a sweep, to be drawn
  gallery         a panel for each
  animate_ramp    a beam in motion beside the curve that it traces
  animate_beams   several beams in motion, side by side
  save_animation  as .gif or .mp4
  curves          a measure against actuation
  branches        what `trace_branch` found

To play
  interact        a window with sliders, in which the tip can be dragged
  Window          that window, on a figure of your own

To draw into axes of your own
  limits, Limits  axis limits that hold several states
  PALETTE         colours of tendons and curves
  MARKERS         markers of curves

All but `interact` draw into the `ax` they are given or into a new `Figure`, and leave pyplot, its backend and
`rcParams` alone, so that they work without a display. Save a still with `ax.figure.savefig(path)` and an animation with
`save_animation`. Lengths, forces and stresses are in the user's units.

A tendon that pulls is drawn solid, one that pushes dashed, and a slack cable thin and pale. The patch of surface that
an anchor of finite width pulls on is a heavier line in the tendon's colour. A rod, whose nodes are `(n, 3)`, is drawn
as its centre line. Colours are those of Okabe and Ito (2008), which survive colour blindness; several curves also
differ in their markers.

Whatever acts on a body from outside is drawn, in the state that the picture shows. Forces on nodes and the total weight
are arrows to one scale: the longest is a tenth of the body. Forces per length, such as traction and pressure, are rows
of arrows outside the body, to a scale of their own. In an animation or a gallery the scales are those of all states. A
rigid obstacle is grey, with a hatched rim; limits of axes hold it as far as it lies close to the body. Springs are
zigzags that end outside the body. Supports are walls, blocks that move, and triangles (see `jaxbeam.plot.supports`).
"""

from jaxbeam.mesh.sketch import PALETTE as PALETTE
from jaxbeam.plot.animations import animate_beams as animate_beams
from jaxbeam.plot.animations import animate_ramp as animate_ramp
from jaxbeam.plot.animations import save_animation as save_animation
from jaxbeam.plot.drawing import MARKERS as MARKERS
from jaxbeam.plot.drawing import Limits as Limits
from jaxbeam.plot.drawing import limits as limits
from jaxbeam.plot.fields import Field as Field
from jaxbeam.plot.picture import Picture as Picture
from jaxbeam.plot.picture import beam as beam
from jaxbeam.plot.picture import field as field
from jaxbeam.plot.states import States as States
from jaxbeam.plot.stills import branches as branches
from jaxbeam.plot.stills import curves as curves
from jaxbeam.plot.stills import gallery as gallery
from jaxbeam.plot.window import Window as Window
from jaxbeam.plot.window import interact as interact
