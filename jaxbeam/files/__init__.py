"""Files: meshes in, results out, and an archive of a scene with its solution.

It is imported by itself, as `from jaxbeam import files`. Meshes and VTU files go through meshio, which is imported when
it is needed: `pip install 'jaxbeam[files]'`. The table and the archive need nothing more than jaxbeam.

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
