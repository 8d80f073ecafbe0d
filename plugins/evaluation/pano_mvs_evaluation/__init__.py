"""Comparison of poses, range maps and clouds with ground truth.

Four functions compare and return records; nothing here prints. `summary()` of a record, or `depth_summary`, gives the
figures as text, `to_json()` as JSON values.

Layout: `inputs` finds estimates and truth and pairs them; `poses`, `ranges` and `clouds` score them, each without the
others' results (`ranges` and `clouds` use `poses.alignment`); `capture` combines them.
"""

from pano_mvs_evaluation.capture import RunEvaluation, evaluate_run
from pano_mvs_evaluation.clouds.evaluate import CloudEvaluation, evaluate_cloud
from pano_mvs_evaluation.clouds.pictures import write_error_clouds, write_overview
from pano_mvs_evaluation.poses import PoseEvaluation, evaluate_poses
from pano_mvs_evaluation.ranges.error_picture import write_depth_pictures
from pano_mvs_evaluation.ranges.evaluate import DepthEvaluation, evaluate_depth
from pano_mvs_evaluation.ranges.tables import depth_summary, write_depth_csv, write_depth_scores
from pano_mvs_evaluation.ranges.view_scores import BadLimit, ScoreSettings

__all__ = [
    "BadLimit",
    "CloudEvaluation",
    "DepthEvaluation",
    "PoseEvaluation",
    "RunEvaluation",
    "ScoreSettings",
    "depth_summary",
    "evaluate_cloud",
    "evaluate_depth",
    "evaluate_poses",
    "evaluate_run",
    "write_depth_csv",
    "write_depth_pictures",
    "write_depth_scores",
    "write_error_clouds",
    "write_overview",
]
