# SPDX-License-Identifier: Apache-2.0
"""TI's radar patch image for the AWR2243: found, checked, cut into the chunks that a chip is sent.

The image cannot be shipped (TI's licence). It is ``firmware/xwr22xx_metaImage.bin`` of TI's mmWave device firmware
package (mmWave DFP 2.x). The file is 7936 bytes that begin with MSTR, and their CRC-32, which is not sent.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

from edge.errors import FirmwareError

IMAGE_BYTES, TRAILER_BYTES = 7936, 4
CHUNKS = 35
_MAGIC = b"MSTR"
_FILE_TYPE = 0
_CHUNK_BYTES = 232
_ALLOWED = f"{IMAGE_BYTES + TRAILER_BYTES} bytes that begin with {_MAGIC.decode()} and end with their CRC-32"
_ACTION = (
    "take firmware/xwr22xx_metaImage.bin of TI's mmWave DFP 2.x for the AWR2243 (ti.com/tool/MMWAVE-DFP) and set "
    "radars.<id>.board.firmware to its path"
)


def load_image(name: str, rig_directory: Path) -> bytes:
    """The image without its trailer.

    Args:
        name: path; a relative one starts at the rig's folder.
        rig_directory: that folder.
    Returns:
        7936 bytes.
    Raises:
        FirmwareError: no path, no such file, or a file that is not the image; says what is wrong with it.
    """
    if not name:
        raise FirmwareError("no firmware image for the cascade's radar chips", allowed=_ALLOWED, action=_ACTION)
    path = rig_directory / Path(name).expanduser()
    try:
        with path.open("rb") as file:
            data = file.read(IMAGE_BYTES + TRAILER_BYTES + 1)
    except OSError as error:
        raise FirmwareError(
            f"firmware image {path} cannot be read", value=error.strerror, allowed=_ALLOWED, action=_ACTION
        ) from error
    if len(data) != IMAGE_BYTES + TRAILER_BYTES:
        size = f"{path.stat().st_size} bytes"
        raise FirmwareError(f"firmware image {path} has another size", value=size, allowed=_ALLOWED, action=_ACTION)
    image, trailer = data[:IMAGE_BYTES], data[IMAGE_BYTES:]
    if image[: len(_MAGIC)] != _MAGIC:
        begin = image[: len(_MAGIC)]
        raise FirmwareError(f"{path} is no firmware image", value=begin, allowed=_ALLOWED, action=_ACTION)
    crc = zlib.crc32(image).to_bytes(TRAILER_BYTES, "little")
    if trailer != crc:
        raise FirmwareError(
            f"firmware image {path} is damaged: its CRC-32 is {crc.hex()}", value=trailer.hex(), action=_ACTION
        )
    return image


def chunks(image: bytes) -> list[bytes]:
    """Data of the 35 file sub-blocks: type, length and 224 bytes first, then 232 bytes each, 56 in the last."""
    data = struct.pack("<2I", _FILE_TYPE, len(image)) + image
    return [data[start : start + _CHUNK_BYTES] for start in range(0, len(data), _CHUNK_BYTES)]
