import pytest
from tests.io.frame_files import FRAME_FILES, FrameFile
from tests.io.frame_format_tests import FrameFormatTests


class TestEveryFormat(FrameFormatTests):
    @pytest.fixture(params=FRAME_FILES)
    def kind(self, request: pytest.FixtureRequest) -> FrameFile:
        return FRAME_FILES[request.param]
