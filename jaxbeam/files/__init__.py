"""Files: meshes in, results out, and an archive of a scene with its solution.

It is imported by itself, as `from jaxbeam import files`. Meshes and VTU files go through meshio, which is imported when
it is needed: `pip install 'jaxbeam[files]'`. The table and the archive need nothing more than jaxbeam.

When to use what:

- `read_mesh` for a body from a mesh generator, with its named groups to clamp, load and fill;
- `write_vtu` for one state in ParaView, `write_path` for all states of a ramp or sweep;
- `write_csv` for a table of commands and measures, for a spreadsheet or other programs;
- `save` and `load` to go on with a scene and its solution in another process, the same to the last bit.

Whatever is written goes into a temporary file beside the target first, and takes its name when it is whole. A process
that is killed while it writes leaves an earlier file of that name as it was.
"""

from jaxbeam.files.archive import load as load
from jaxbeam.files.archive import save as save
from jaxbeam.files.reading import MeshFile as MeshFile
from jaxbeam.files.reading import read_mesh as read_mesh
from jaxbeam.files.table import write_csv as write_csv
from jaxbeam.files.vtu import write_path as write_path
from jaxbeam.files.vtu import write_vtu as write_vtu
