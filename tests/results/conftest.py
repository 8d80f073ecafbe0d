from tests.report.conftest import results, tiny

__all__ = ["results", "tiny"]
