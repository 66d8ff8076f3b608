"""Making TORCS' track files safe to read for its own parser.

They claim UTF-8 but hold Latin-1 bytes and pull in other files as external entities. Under a Python that is linked to
the system's expat, that parser refuses the objects' file and the track library then crashes. So it is handed a clean
copy: ASCII, the surfaces inlined, the objects, which the physics does not need, left out.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

from sb3_sap.envs.tracks import read_track_xml

#: Declarations of external entities, what precedes the document, and references to other entities.
ENTITY = re.compile(r'<!ENTITY\s+([\w.-]+)\s+SYSTEM\s+"([^"]*)"\s*>')
PROLOG = re.compile(r"<\?xml.*?\?>|<!--.*?-->|<!DOCTYPE[^\[>]*(\[.*?\]\s*)?>", re.DOTALL)
OTHER_ENTITY = re.compile(r"&(?!amp;|lt;|gt;|quot;|apos;|#)[\w.-]+;")
#: The entity that is inlined: the road surfaces.
KEPT_ENTITY = "default-surfaces"


def flatten(path: Path) -> bytes:
    """The track file as one clean XML document.

    :raise ValueError: if it is not a track file that TORCS could build, saying what is wrong
    """
    read_track_xml(path)  # says what is missing of the plan; TORCS would crash
    text = _read(path)
    for name, target in ENTITY.findall(text):
        inlined = path.parent / target
        if name == KEPT_ENTITY and not inlined.is_file():
            raise ValueError(f"{path} needs {inlined}, the road surfaces, which is missing: install TORCS' data again.")
        replacement = PROLOG.sub("", _read(inlined)) if name == KEPT_ENTITY else ""
        text = text.replace(f"&{name};", replacement)
    text = OTHER_ENTITY.sub("", PROLOG.sub("", text))
    try:
        root = ElementTree.fromstring(text.strip())
    except ElementTree.ParseError as error:
        raise ValueError(f"{path} is not a readable TORCS track file: {error}.") from error
    document: bytes = ElementTree.tostring(root, encoding="us-ascii", xml_declaration=True)
    return document


def _read(path: Path) -> str:
    return path.read_bytes().decode("latin-1")
