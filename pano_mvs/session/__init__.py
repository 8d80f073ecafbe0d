"""Run and plan workflows: from a workflow's name and a folder of images to the results of a run."""
