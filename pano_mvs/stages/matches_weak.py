"""The choice of images for learned matches.

It has a module of its own because it knows poses: a change of their code would compute all matches again.
"""

from __future__ import annotations

from pano_mvs.algorithms.learned.weak_images import weak_images
from pano_mvs.api import All, Context, Features, One, Params, Poses, TwoView, arguments_from, stage
from pano_mvs.core.text import plural
from pano_mvs.scene import WeakImages


@stage("matches.weak", settings=weak_images, memory="600MB")
def weak(features: All[Features], matches: All[TwoView], poses: One[Poses], params: Params, ctx: Context) -> WeakImages:
    """Find the images that need learned matches, by poses that were solved without them.

    These are images that are not in the group of poses with most images, or that a single pair holds there. The images
    most similar to them get learned key points, too.
    """
    settings = arguments_from(weak_images, params)
    found = weak_images(features, matches, poses, **settings)
    ctx.metric("weak", len(found.weak) / max(1, len(features)))
    if found.weak and settings["learned"] == "auto":
        count, total = len(found.weak), len(features)
        ctx.note(
            f"{count} of {total} {plural(total, 'image')} {plural(count, 'is', 'are')} not placed among most others by "
            f"two or more pairs, so neural networks match {plural(count, 'it', 'them')}, too (learned: never in this "
            "stage forbids it)"
        )
    return found
