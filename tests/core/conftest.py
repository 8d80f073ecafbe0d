from tests.engine.conftest import toy

__all__ = ["toy"]
