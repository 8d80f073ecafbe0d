"""Judge whether aligned blocks agree about their common cameras."""

from __future__ import annotations

from collections.abc import Sequence

from pano_mvs.algorithms.blocks import MIN_COMMON, BlockAlignment, BlockLink
from pano_mvs.core.errors import InputError
from pano_mvs.core.text import plural
from pano_mvs.session.merging.block import Block

# As shares of the distance between neighbouring cameras, and in degrees: medians over the common cameras of two blocks.
DOUBTFUL_OFFSET, REFUSED_OFFSET = 0.05, 0.25
DOUBTFUL_TURN_DEG, REFUSED_TURN_DEG = 0.5, 3.0
_DOUBTFUL_CAMERA = 0.5  # of the distance between neighbouring cameras


def require_connected(blocks: Sequence[Block], alignment: BlockAlignment) -> None:
    """Check that all blocks are connected by common cameras.

    Raises:
        InputError: if one is not; it names the block.
    """
    lost = [number for number, similarity in enumerate(alignment.world_from_block) if similarity is None]
    if not lost:
        return
    number = lost[0]
    own = set(blocks[number].poses.names)
    common = {other: len(own & set(block.poses.names)) for other, block in enumerate(blocks) if other != number}
    best = max(common, key=lambda other: (common[other], -other))
    few = common[best] < MIN_COMMON
    raise InputError(
        f"{blocks[number].name}: "
        + (
            f"shares {common[best]} registered {plural(common[best], 'camera')} with {blocks[best].name}, and fewer "
            f"with the other blocks; {MIN_COMMON} are needed, and 20 or more are better. "
            if few
            else f"shares cameras only with blocks such as {blocks[best].name} that are not connected to the others. "
        )
        + "Let blocks overlap by images that see each other, with the same names in all blocks"
    )


def require_agreement(blocks: Sequence[Block], alignment: BlockAlignment) -> None:
    """Check that the common cameras of all pairs of blocks agree at least roughly.

    Raises:
        InputError: if those of a pair do not; it names the blocks and the disagreement.
    """
    bad = [
        link for link in alignment.links if link.relative_offset > REFUSED_OFFSET or link.turn_deg > REFUSED_TURN_DEG
    ]
    if bad:
        worst = max(bad, key=lambda link: (link.relative_offset, link.turn_deg))
        raise InputError(
            f"{blocks[worst.first].name} and {blocks[worst.second].name} disagree about their "
            f"{len(worst.names)} common cameras: {link_text(worst)}. One of the models is wrong, or images of the same "
            "name differ. Look at the reports of both"
        )


def link_text(link: BlockLink) -> str:
    """Return the agreement of two blocks in words."""
    return (
        f"positions differ by {_small(100 * link.relative_offset)} % of the distance between neighbouring cameras, "
        f"orientations by {_small(link.turn_deg)}° (medians)"
    )


def _small(value: float) -> str:
    return f"{value:.2g}" if value >= 0.001 else "less than 0.001"


def is_doubtful(link: BlockLink) -> bool:
    """Return whether two blocks agree less than usual."""
    return link.relative_offset > DOUBTFUL_OFFSET or link.turn_deg > DOUBTFUL_TURN_DEG


def camera_doubts(blocks: Sequence[Block], alignment: BlockAlignment) -> dict[str, str]:
    """Return the common cameras that two blocks place differently, with the reason."""
    doubts: dict[str, str] = {}
    for link in alignment.links:
        for name, offset in zip(link.names, link.offsets.tolist(), strict=True):
            if offset > _DOUBTFUL_CAMERA * link.spacing:
                doubts[name] = (
                    f"{blocks[link.first].name} and {blocks[link.second].name} place it "
                    f"{offset / link.spacing:.2g} times the distance between neighbouring cameras apart"
                )
    return doubts


def scale_notes(blocks: Sequence[Block], alignment: BlockAlignment) -> list[str]:
    """Return notes on blocks that state metres but are of different size."""
    notes = []
    reference = blocks[alignment.reference]
    for block, similarity in zip(blocks, alignment.world_from_block, strict=True):
        assert similarity is not None
        if reference.poses.metric and block.poses.metric and abs(similarity.scale - 1) > 0.02:
            notes.append(
                f"{block.name} and {reference.name} both state metres, but differ in scale by "
                f"{100 * abs(similarity.scale - 1):.2g} %. The metres of {reference.name} are used"
            )
    return notes
