"""Compression of stored values: their bytes are shuffled, as by Blosc, and compressed with Zstandard.

Of numbers of several bytes, the first bytes of all come first, then the second bytes, and so on, since bytes of equal
significance resemble each other. A value is divided into chunks, so that only a part of it is in memory at a time:

    magic, size of an element (1 byte), size of the value (8 bytes), size of each chunk (4 bytes each), chunks

Numbers are little endian. What a value is stored under stays the digest of its own bytes.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import IO

import numpy as np
import zstandard
from numpy.typing import NDArray

_MAGIC = b"pmvz\x01"
_CHUNK_BYTES = 1 << 20
_LEVEL = 1  # level 3 saves 3 % more, and takes twice as long
_SAMPLE_BYTES = 1 << 16
_MOST_STRIDE = 64
_PAYS_BELOW = 0.9  # share of the size


def stride_of(source: IO[bytes], size_bytes: int) -> int:
    """Return the size of the elements of which a file seems to consist, found by compressing a sample from its middle.

    Returns:
        1 to 64; 0 if compression does not pay, as for most images.
    """
    source.seek(max(0, (size_bytes - _SAMPLE_BYTES) // 2))
    sample = np.frombuffer(source.read(_SAMPLE_BYTES), np.uint8)
    compressor = zstandard.ZstdCompressor(level=_LEVEL)
    plain = len(compressor.compress(sample.data))
    if plain > 0.97 * len(sample):
        return 0
    sizes = {stride: len(compressor.compress(_shuffled(sample, stride).data)) for stride in range(2, _MOST_STRIDE + 1)}
    best = min(sizes, key=lambda stride: (sizes[stride], stride))
    if min(plain, sizes[best]) > _PAYS_BELOW * len(sample):
        return 0
    return best if sizes[best] < plain else 1


def compress(source: IO[bytes], size_bytes: int, target: IO[bytes], *, element_bytes: int) -> int:
    """Compress a value and return the compressed size; 0 if that does not pay.

    Args:
        source: at the beginning of the value.
        target: a seekable file, at the place for the compressed value. If it does not pay, it is at this place again.

    Raises:
        EOFError: if the source ends early.
    """
    begin = target.tell()
    chunks = -(-size_bytes // _CHUNK_BYTES)
    head = _MAGIC + bytes([element_bytes]) + size_bytes.to_bytes(8, "little")
    target.write(head + bytes(4 * chunks))
    compressor = zstandard.ZstdCompressor(level=_LEVEL)
    lengths = np.zeros(chunks, "<u4")
    left, allowed = size_bytes, _PAYS_BELOW * size_bytes
    for idx in range(chunks):
        data = source.read(min(left, _CHUNK_BYTES))
        if len(data) < min(left, _CHUNK_BYTES):
            raise EOFError("the value is shorter than it was")
        left -= len(data)
        lengths[idx] = target.write(compressor.compress(_shuffled(np.frombuffer(data, np.uint8), element_bytes).data))
        if target.tell() - begin > allowed:
            target.seek(begin)
            target.truncate()
            return 0
    end = target.tell()
    target.seek(begin + len(head))
    target.write(lengths.tobytes())
    target.seek(end)
    return end - begin


def decompressed_chunks(source: IO[bytes], stored_bytes: int) -> Iterator[NDArray[np.uint8]]:
    """Yield the bytes of a compressed value, one part at a time.

    Args:
        source: at the beginning of the compressed value.
        stored_bytes: size of the compressed value.

    Raises:
        ValueError: if it is not a compressed value, or damaged.
    """
    head = source.read(len(_MAGIC) + 9)
    if len(head) < len(_MAGIC) + 9 or not head.startswith(_MAGIC):
        raise ValueError("not a compressed value")
    element_bytes, size_bytes = head[len(_MAGIC)], int.from_bytes(head[len(_MAGIC) + 1 :], "little")
    chunks = -(-size_bytes // _CHUNK_BYTES)
    if not 1 <= element_bytes <= _MOST_STRIDE or len(head) + 4 * chunks > stored_bytes:
        raise ValueError("a compressed value with a damaged beginning")
    lengths = np.frombuffer(source.read(4 * chunks), "<u4")
    if len(head) + 4 * chunks + int(lengths.sum(dtype=np.uint64)) != stored_bytes:
        raise ValueError("a compressed value with a wrong size")
    decompressor = zstandard.ZstdDecompressor()
    for idx, length in enumerate(lengths.tolist()):
        expected = min(_CHUNK_BYTES, size_bytes - idx * _CHUNK_BYTES)
        data = source.read(length)
        try:
            if zstandard.frame_content_size(data) != expected:  # before as much memory is reserved
                raise ValueError("a compressed chunk with a wrong size")
            chunk = np.frombuffer(decompressor.decompress(data), np.uint8)
        except zstandard.ZstdError as error:
            raise ValueError(str(error)) from error
        yield _unshuffled(chunk, element_bytes)


def decompress(source: IO[bytes], stored_bytes: int, size_bytes: int) -> NDArray[np.uint8]:
    """Return the bytes of a compressed value whose size is known; raise as `decompressed_chunks` does."""
    value = np.empty(size_bytes, np.uint8)
    done = 0
    for chunk in decompressed_chunks(source, stored_bytes):
        if done + len(chunk) > size_bytes:
            raise ValueError("a compressed value of another size")
        value[done : done + len(chunk)] = chunk
        done += len(chunk)
    if done != size_bytes:
        raise ValueError("a compressed value of another size")
    return value


def _shuffled(data: NDArray[np.uint8], element_bytes: int) -> NDArray[np.uint8]:
    """Return bytes by their place in the element; those of an incomplete element stay at the end."""
    count = len(data) // element_bytes
    if element_bytes == 1 or not count:
        return data
    shuffled = np.empty_like(data)
    for byte in range(element_bytes):  # copies from one strided view into another would take ten times as long
        shuffled[byte * count : (byte + 1) * count] = data[byte : count * element_bytes : element_bytes]
    shuffled[count * element_bytes :] = data[count * element_bytes :]
    return shuffled


def _unshuffled(data: NDArray[np.uint8], element_bytes: int) -> NDArray[np.uint8]:
    """Return what `_shuffled` was given."""
    count = len(data) // element_bytes
    if element_bytes == 1 or not count:
        return data
    plain = np.empty_like(data)
    for byte in range(element_bytes):
        plain[byte : count * element_bytes : element_bytes] = data[byte * count : (byte + 1) * count]
    plain[count * element_bytes :] = data[count * element_bytes :]
    return plain
