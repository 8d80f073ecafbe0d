"""Photo sphere metadata (GPano XMP) written into JPEG and PNG files.

The fields are those of the "Photo Sphere XMP Metadata" specification. In a JPEG, the packet is an APP1 segment behind
the JFIF header (Adobe's XMP specification, part 3, 1.1.3); in a PNG, an iTXt chunk (1.1.5).
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

_JPEG_XMP, _PNG_XMP = b"http://ns.adobe.com/xap/1.0/\0", b"XML:com.adobe.xmp"
_PACKET = (
    '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?><x:xmpmeta xmlns:x="adobe:ns:meta/">'
    '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description rdf:about="" '
    'xmlns:GPano="http://ns.google.com/photos/1.0/panorama/"{fields}/></rdf:RDF></x:xmpmeta><?xpacket end="w"?>'
)


def add_level_gpano(path: Path, size_hw: tuple[int, int], *, heading_deg: float | None, level: bool) -> None:
    """Add the metadata of a panorama of the whole sphere to a JPEG or PNG file.

    Args:
        path: the file, as OpenCV writes it.
        size_hw: (height, width) of the picture.
        heading_deg: compass heading of its middle; None is not stated.
        level: whether to state that pitch and roll are 0.
    """
    height, width = size_hw
    fields: dict[str, object] = {"UsePanoramaViewer": "True", "ProjectionType": "equirectangular"}
    for name in ("FullPano", "CroppedAreaImage"):
        fields |= {f"{name}WidthPixels": width, f"{name}HeightPixels": height}
    fields |= {"CroppedAreaLeftPixels": 0, "CroppedAreaTopPixels": 0}
    fields |= {"PosePitchDegrees": 0, "PoseRollDegrees": 0} if level else {}
    fields |= {} if heading_deg is None else {"PoseHeadingDegrees": f"{heading_deg % 360:.6g}"}
    stated = "".join(f' GPano:{name}="{value}"' for name, value in fields.items())
    packet = _PACKET.format(fields=stated).encode()
    data = path.read_bytes()
    if data.startswith(b"\x89PNG"):
        chunk = b"iTXt" + _PNG_XMP + b"\0" * 5 + packet
        framed = struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk))
        at = 8 + 25  # behind the signature and IHDR
    else:
        framed = b"\xff\xe1" + struct.pack(">H", 2 + len(_JPEG_XMP) + len(packet)) + _JPEG_XMP + packet
        at = 4 + struct.unpack(">H", data[4:6])[0] if data[2:4] == b"\xff\xe0" else 2
    path.write_bytes(data[:at] + framed + data[at:])
