"""Evaluation against ground truth within a workflow."""

from __future__ import annotations

from functools import partial

from pydantic import Field

from pano_mvs.api import All, InputPath, One, Panorama, Params, Poses, RangeMap, Scores, stage


class TruthParams(Params):
    """Settings of evaluate.truth."""

    truth: InputPath = Field(description="folder with poses.json and depth.npz")


@stage("evaluate.truth")
def truth(images: All[Panorama], poses: One[Poses], ranges: All[RangeMap], params: TruthParams) -> Scores:
    """Compare poses and range maps with ground truth.

    An image is scored if the ground truth contains its name and, where the truth states the image's SHA-256, if the
    hashes match: a different image with the same name is not scored. Masked pixels are ignored. Each group of poses is
    aligned with the truth on its own; pairs across groups count as not registered.
    """
    from pano_mvs.io.truth import read_truth
    from pano_mvs_evaluation.capture import score_capture  # the package takes 0.1 s to import

    known = read_truth(params.truth)
    notes: list[str] = []
    matched = {}
    for name, view in known.match(list(images)).items():
        if view.belongs_to(images[name].image):
            matched[name] = view
        else:
            notes.append(f"{name} is not the image that the truth in {params.truth.name} belongs to")
    scored = [name for name in matched if name in ranges]
    scores = score_capture(
        poses.cameras,
        {name: view.cam_from_world for name, view in matched.items()},
        estimated_ranges={name: ranges[name].range for name in scored},
        true_ranges={name: partial(known.range_map, view) for name, view in matched.items()},
        confidences={name: ranges[name].confidence for name in scored},
        masks={name: images[name].load_mask() for name in scored},
        groups=dict(zip(poses.names, poses.groups.tolist(), strict=True)),
    )
    return Scores(scores.poses, scores.views, (*scores.notes, *notes))
