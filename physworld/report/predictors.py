"""Who predicts: what each predictor is called and which role, hence colour, it has in every picture.

The colours of the roles lie in ``palette.css``, for light and for dark.
"""

from __future__ import annotations

from dataclasses import dataclass

NOISE = "noise"


@dataclass(frozen=True)
class Predictor:
    """What a predictor is called, its role in ``palette.css``, and its dash where it is a baseline."""

    label: str
    role: str
    dash: str | None = None

    @property
    def baseline(self) -> bool:
        """Whether it knows no physics: something to be better than."""
        return self.dash is not None


PREDICTORS = {
    "static": Predictor("static", "static", "2 4"),
    "rigid_follow": Predictor("rigid follow", "rigid", "7 3"),
    "constant_velocity": Predictor("constant velocity", "velocity", "7 3 2 3"),
    "persistence": Predictor("persistence", "persistence", "4 4"),
    "before": Predictor("before", "before"),
    "after": Predictor("after", "after"),
    "twin_homogeneous": Predictor("twin without its field", "field"),
    "twin": Predictor("twin", "twin"),
    "world_model": Predictor("world model", "calibrated"),
    "world_model_finetuned": Predictor("world model, fine-tuned", "model"),
}
"""By the names that results have them under, baselines first."""
