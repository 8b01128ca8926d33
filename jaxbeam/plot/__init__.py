"""Pictures and animations of beams. Only this folder needs matplotlib, so it must be imported by name.

Every function draws into the `ax` it is given or into a new `Figure`, and leaves pyplot, its backend and `rcParams`
alone, so that it works without a display. Save a still with `ax.figure.savefig(path)` and an animation with
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

from jaxbeam.plot.animations import animate_beams as animate_beams
from jaxbeam.plot.animations import animate_ramp as animate_ramp
from jaxbeam.plot.animations import save_animation as save_animation
from jaxbeam.plot.drawing import MARKERS as MARKERS
from jaxbeam.plot.drawing import PALETTE as PALETTE
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
