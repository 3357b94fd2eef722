# SPDX-License-Identifier: Apache-2.0
"""Writes what stands in a recording before its first message: metadata, attachments, schemas and channels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from edge.frames import RadarId
from edge.recording import schema
from edge.recording.mcap_writing import McapWriter

LIBRARY = "rfconstruct"


def write_head(
    writer: McapWriter, metadata: Mapping[str, str], attachments: Mapping[str, bytes], radars: Sequence[RadarId]
) -> dict[str, int]:
    """Write it, outside of chunks, so that no damaged chunk takes it away.

    Args:
        writer: of an empty file.
        metadata: what kind of recording it is.
        attachments: name -> content.
        radars: whose frames it may hold.
    Returns:
        Topic -> channel id.
    Raises:
        OSError: of the file.
    """
    writer.add_metadata(schema.METADATA, dict(metadata))
    for name, content in attachments.items():
        writer.add_attachment(name, "application/octet-stream", content)
    frame_schema = writer.add_schema(schema.FRAME_SCHEMA, "x-text", (schema.__doc__ or "").encode())
    pose_schema = writer.add_schema(schema.POSE_SCHEMA, "jsonschema", schema.POSE_JSON_SCHEMA)
    result_schema = writer.add_schema(schema.RESULT_SCHEMA, "", b"")
    kinds = [(schema.FRAME_TOPICS[radar], schema.FRAME_ENCODING, frame_schema) for radar in radars]
    kinds.append((schema.POSE_TOPIC, schema.POSE_ENCODING, pose_schema))
    kinds += [(topic, schema.RESULT_ENCODING, result_schema) for topic in schema.RESULT_TOPICS]
    return {topic: writer.add_channel(topic, encoding, schema_id) for topic, encoding, schema_id in kinds}
