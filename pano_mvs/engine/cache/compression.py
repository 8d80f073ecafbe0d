"""Compression of stored values: their bytes are shuffled, as by Blosc, and compressed with Zstandard.

Of numbers of several bytes, the first bytes of all come first, then the second bytes, and so on, since bytes of equal
significance resemble each other; of points, likewise, first those of all x. Where that is smaller, as for exponents but
not for the last bits of a measurement, each of these bytes is replaced by its difference from the one before it, as by
the predictor of TIFF for floating-point numbers. A value is divided into chunks, so that only a part of it is in memory
at a time:

    magic, shuffle (9 bytes), size of the value (8 bytes), size of each compressed chunk (4 bytes each), chunks

Numbers are little endian. What a value is stored under stays the digest of its own bytes.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import IO, NamedTuple

import numpy as np
import zstandard
from numpy.typing import NDArray

_MAGIC = b"pmvz\x01"
_CHUNK_BYTES = 1 << 20
_LEVEL = 1  # level 3 saves 3 % more, and takes twice as long
_SAMPLE_BYTES = 1 << 16
_DIFFERENCES_PAY_BELOW = 0.95  # share of the size without them; to read them takes longer
MOST_STRIDE = 64
_PAYS_BELOW = 0.9  # share of the size


class Shuffle(NamedTuple):
    """How the bytes of a value are ordered before they are compressed."""

    stride: int = 1  # size in bytes of the elements, 1 to 64
    # the bytes of an element that are replaced by their difference from those of the element before it: bit by bit
    differences: int = 0

    def to_bytes(self) -> bytes:
        """Return it as bytes."""
        return bytes([self.stride]) + self.differences.to_bytes(8, "little")

    @staticmethod
    def from_bytes(data: bytes) -> Shuffle:
        """Return the shuffle in nine bytes; raise ValueError if there is none."""
        shuffle = Shuffle(data[0], int.from_bytes(data[1:], "little"))
        if not 1 <= shuffle.stride <= MOST_STRIDE or shuffle.differences >> shuffle.stride:
            raise ValueError("a compressed value with a damaged beginning")
        return shuffle

    def has_differences(self, byte: int) -> bool:
        """Return whether a byte of each element is replaced by its difference from that of the element before it."""
        return bool(self.differences >> byte & 1)


def shuffle_of_array(source: IO[bytes], size_bytes: int, *, stride: int) -> Shuffle:
    """Return the shuffle that compresses a sample from the middle of an array best, given the size of its elements."""
    return _with_differences(_sample(source, size_bytes), stride)


def shuffle_of_file(source: IO[bytes], size_bytes: int) -> Shuffle | None:
    """Return the shuffle that compresses a sample of a file of unknown content best; None if none pays.

    Most images are compressed already; the points of a PLY file are not.
    """
    sample = _sample(source, size_bytes)
    if _sample_bytes(sample, Shuffle()) > 0.97 * len(sample):
        return None
    sizes = {Shuffle(stride): _sample_bytes(sample, Shuffle(stride)) for stride in range(1, MOST_STRIDE + 1)}
    best = min(sizes, key=lambda shuffle: (sizes[shuffle], shuffle))
    return _with_differences(sample, best.stride) if sizes[best] <= _PAYS_BELOW * len(sample) else None


def _sample(source: IO[bytes], size_bytes: int) -> NDArray[np.uint8]:
    source.seek(max(0, (size_bytes - _SAMPLE_BYTES) // 2))
    return np.frombuffer(source.read(_SAMPLE_BYTES), np.uint8)


def _with_differences(sample: NDArray[np.uint8], stride: int) -> Shuffle:
    """Return the shuffle with differences of those bytes of an element for which they are notably smaller."""
    compressor, mask = zstandard.ZstdCompressor(level=_LEVEL), 0
    for byte in range(stride):
        plain = np.ascontiguousarray(sample[byte::stride])
        smaller = len(compressor.compress(np.diff(plain).data)) < _DIFFERENCES_PAY_BELOW * len(
            compressor.compress(plain.data)
        )
        mask |= smaller << byte
    return Shuffle(stride, mask)


def _sample_bytes(sample: NDArray[np.uint8], shuffle: Shuffle) -> int:
    return len(zstandard.ZstdCompressor(level=_LEVEL).compress(_shuffled(sample, shuffle).data))


def compress(source: IO[bytes], size_bytes: int, target: IO[bytes], *, shuffle: Shuffle) -> int:
    """Compress a value and return the compressed size; 0 if that does not pay.

    Args:
        source: at the beginning of the value.
        target: a seekable file, at the place for the compressed value. If it does not pay, it is at this place again.

    Raises:
        EOFError: if the source ends early.
    """
    begin = target.tell()
    chunks = -(-size_bytes // _CHUNK_BYTES)
    head = _MAGIC + shuffle.to_bytes() + size_bytes.to_bytes(8, "little")
    target.write(head + bytes(4 * chunks))
    compressor = zstandard.ZstdCompressor(level=_LEVEL)
    lengths = np.zeros(chunks, "<u4")
    left, allowed = size_bytes, _PAYS_BELOW * size_bytes
    for idx in range(chunks):
        data = source.read(min(left, _CHUNK_BYTES))
        if len(data) < min(left, _CHUNK_BYTES):
            raise EOFError("the value is shorter than it was")
        left -= len(data)
        lengths[idx] = target.write(compressor.compress(_shuffled(np.frombuffer(data, np.uint8), shuffle).data))
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
    head = source.read(len(_MAGIC) + 17)
    if len(head) < len(_MAGIC) + 17 or not head.startswith(_MAGIC):
        raise ValueError("not a compressed value")
    shuffle, size_bytes = Shuffle.from_bytes(head[len(_MAGIC) : -8]), int.from_bytes(head[-8:], "little")
    chunks = -(-size_bytes // _CHUNK_BYTES)
    if len(head) + 4 * chunks > stored_bytes:
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
        yield _unshuffled(chunk, shuffle)


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


def _shuffled(data: NDArray[np.uint8], shuffle: Shuffle) -> NDArray[np.uint8]:
    """Return bytes by their place in the element; those of an incomplete element stay at the end."""
    count = len(data) // shuffle.stride
    whole = count * shuffle.stride
    ordered = np.empty_like(data)
    for byte in range(shuffle.stride):  # copies from one strided view into another would take ten times as long
        plain, place = data[byte : whole : shuffle.stride], ordered[byte * count : (byte + 1) * count]
        place[:] = plain
        if shuffle.has_differences(byte):
            place[1:] -= plain[:-1]
    ordered[whole:] = data[whole:]
    return ordered


def _unshuffled(data: NDArray[np.uint8], shuffle: Shuffle) -> NDArray[np.uint8]:
    """Return what `_shuffled` was given."""
    count = len(data) // shuffle.stride
    whole = count * shuffle.stride
    plain = np.empty_like(data)
    for byte in range(shuffle.stride):
        ordered = data[byte * count : (byte + 1) * count]
        if shuffle.has_differences(byte):
            ordered = np.cumsum(ordered, dtype=np.uint8)
        plain[byte : whole : shuffle.stride] = ordered
    plain[whole:] = data[whole:]
    return plain
