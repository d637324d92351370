"""Changes bits of the container of an MP4 that OpenCV wrote: what its encoder cannot say."""

import struct


def change_mp4(path, clockwise=None, aspect=None, boxes=b""):
    """Write the rotation into the header of the track, the aspect into that of the sample, boxes into the film's."""
    data = bytearray(path.read_bytes())
    if clockwise:
        at, one = data.index(b"tkhd") - 4, 1 << 16
        stop = at + struct.unpack_from(">I", data, at)[0]
        w, h = struct.unpack_from(">II", data, stop - 8)
        turn = {90: (0, one, 0, -one, 0, 0, h, 0), 180: (-one, 0, 0, 0, -one, 0, w, h)}[clockwise]
        struct.pack_into(">9i", data, stop - 44, *turn, 1 << 30)
    if aspect:
        at, outer = 0, []
        for kind in (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stsd"):
            at = data.index(kind, at)
            outer.append(at - 4)
        entry = outer[-1] + 16
        stop = entry + struct.unpack_from(">I", data, entry)[0]
        data[stop:stop] = struct.pack(">I4sII", 16, b"pasp", *aspect)
        for a in (*outer, entry):
            struct.pack_into(">I", data, a, struct.unpack_from(">I", data, a)[0] + 16)
    if boxes:
        at = data.index(b"moov") - 4
        size = struct.unpack_from(">I", data, at)[0]
        assert at + size == len(data)  # it is the last, so that nothing moves
        struct.pack_into(">I", data, at, size + len(boxes))
        data += boxes
    path.write_bytes(data)
