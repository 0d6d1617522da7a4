"""Calibration boards, and where an image shows their corners."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PositiveFloat, PositiveInt, model_validator

from apex_ompl.errors import ParameterError
from apex_ompl.perception.library import opencv
from apex_ompl.types import Array
from apex_ompl.util.schema import StrictModel

DICTIONARY = "DICT_4X4_250"  # of the markers of ChArUco boards and of tags
FEWEST = 6  # corners of a ChArUco board that are enough

Inner = Annotated[PositiveInt, Field(ge=2, le=50)]


class Board(StrictModel):
    """A flat board with corners that can be found in images.

    Its frame is in the middle of its corners, x along the columns, y along the rows, z out of the back: a camera that
    looks straight at the upright board has the same axes.

    Attributes:
        kind: ``chessboard``, whose first inner square is dark; ``charuco``, a chessboard with markers, which may be
            seen in part; or ``tag``, one marker of the dictionary, whose corners begin at the upper left.
        columns: Inner corners in a row, of a chessboard or ChArUco board.
        rows: Inner corners in a column.
        square: Side of a square, or of the tag [m].
        marker: Side of a ChArUco board's marker as a share of the square's.
        dictionary: Markers of ChArUco boards and tags, as OpenCV names them.
        identity: Number of the tag's marker.
    """

    kind: Literal["chessboard", "charuco", "tag"] = "charuco"
    columns: Inner = 9
    rows: Inner = 6
    square: PositiveFloat = 0.025
    marker: Annotated[PositiveFloat, Field(lt=1.0)] = 0.75
    dictionary: str = DICTIONARY
    identity: Annotated[int, Field(ge=0)] = 0

    @model_validator(mode="after")
    def _has_one_way_up(self) -> Self:
        if self.kind == "chessboard" and (self.columns + self.rows) % 2 == 0:
            raise ValueError("expected a chessboard with an odd and an even number of corners, to tell which end is up")
        return self

    @property
    def corners(self) -> Array:
        """The corners in the frame of the board, row by row, shape (N, 3) [m]; of a tag clockwise."""
        if self.kind == "tag":
            around = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
            return around * self.square / 2.0
        y, x = np.mgrid[0 : self.rows, 0 : self.columns]
        flat = np.stack([x.ravel(), y.ravel(), np.zeros(self.rows * self.columns)], axis=1)
        return np.asarray((flat - flat.mean(axis=0)) * self.square)

    def find(self, color: NDArray[np.uint8]) -> Array | None:
        """Return the pixels of the corners in an image, shape (N, 2), NaN for those not seen; None where there is none.

        Args:
            color: Shape (height, width, 3), of type uint8.

        Raises:
            ApexError: Another image, an unknown dictionary, or OpenCV is not installed.
        """
        color = np.asarray(color)
        if color.dtype != np.uint8 or color.ndim != 3 or color.shape[2] != 3 or not color.size:
            given = f"{color.dtype} of shape {color.shape}"
            raise ParameterError("color", given, "uint8 of shape (height, width, 3)")
        cv2 = opencv()
        gray = cv2.cvtColor(np.ascontiguousarray(color), cv2.COLOR_RGB2GRAY)
        if self.kind == "chessboard":
            seen, found = cv2.findChessboardCornersSB(gray, (self.columns, self.rows), flags=cv2.CALIB_CB_ACCURACY)
            return self._from_dark(gray, np.asarray(found, float).reshape(-1, 2)) if seen else None
        return self._marked(cv2, gray)

    def _from_dark(self, gray: NDArray[np.uint8], pixels: Array) -> Array:
        """Return the corners of a chessboard in the order that begins at a dark square."""
        ends = (pixels, pixels[::-1])
        first, last = (one[[0, 1, self.columns, self.columns + 1]].mean(axis=0).round().astype(int) for one in ends)
        return ends[int(gray[first[1], first[0]] > gray[last[1], last[0]])]

    def _marked(self, cv2: Any, gray: NDArray[np.uint8]) -> Array | None:
        """Return the pixels of the corners of a ChArUco board or a tag."""
        number = getattr(cv2.aruco, self.dictionary, None) if self.dictionary.startswith("DICT_") else None
        if number is None:
            raise ParameterError("dictionary", self.dictionary, "a dictionary of OpenCV's, such as DICT_4X4_250")
        markers = cv2.aruco.getPredefinedDictionary(number)
        if self.kind == "tag":
            settings = cv2.aruco.DetectorParameters()
            settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
            corners, names, _ = cv2.aruco.ArucoDetector(markers, settings).detectMarkers(gray)
            seen = [] if names is None else [k for k, one in enumerate(np.ravel(names)) if one == self.identity]
            return np.asarray(corners[seen[0]], float).reshape(4, 2) if len(seen) == 1 else None
        size = (self.columns + 1, self.rows + 1)
        board = cv2.aruco.CharucoBoard(size, self.square, self.square * self.marker, markers)
        corners, names, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(gray)
        if names is None or len(names) < FEWEST:
            return None
        pixels = np.full((self.columns * self.rows, 2), np.nan)
        pixels[np.ravel(names)] = np.asarray(corners, float).reshape(-1, 2)
        return pixels
