"""What happened in a simulation, to look at: recordings that play in a browser, films, and pictures.

Everything here needs packages that `import diffsim` does not load: ``pip install 'mesh-diffsim[viewer]'``.
"""

from ._draw import Camera, Item, draw_items, picture
from ._record import record, show

__all__ = ["Camera", "Item", "draw_items", "picture", "record", "show"]
