"""Comparison of poses, range maps and clouds with ground truth.

Four functions compare and return records; nothing here prints. `summary()` of a record, or `depth_summary`, gives the
figures as text, `to_json()` as JSON values.

Layout: `inputs` finds estimates and truth and pairs them; `poses`, `ranges` and `clouds` score them, each without the
others' results (`ranges` and `clouds` use `poses.alignment`); `capture` combines them.
"""
