"""What a robot is told when a program at the far end of a link sends a number: the command, its scale and its range."""

import math
from typing import Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from psiu_broker.messages import Value


class ScaledRule(BaseModel):
    """One line of a persona's map. The program's number times `scale`, plus `offset`, is the robot's parameter."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    command: str = Field(min_length=1, description="the robot's command")
    scale: float | None = Field(
        None, allow_inf_nan=False, description="what 1 in the message is to the robot; left out: it takes no parameter"
    )
    offset: float = Field(0.0, allow_inf_nan=False, description="what 0 in the message is to the robot")
    minimum: float | None = Field(None, allow_inf_nan=False, description="a lower parameter is refused")
    maximum: float | None = Field(None, allow_inf_nan=False, description="a greater parameter is refused")
    decimals: int = Field(0, ge=0, le=6, description="digits behind the point; 0: the robot takes whole numbers")

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.scale == 0:
            raise ValueError("scale 0 tells the robot the same whatever the value; leave it out")
        if self.scale is None and (self.offset or self.minimum is not None or self.maximum is not None):
            raise ValueError("offset, minimum and maximum mean nothing without a scale")
        if self.minimum is not None and self.maximum is not None and self.minimum > self.maximum:
            raise ValueError(f"minimum {self.minimum:g} is above maximum {self.maximum:g}")
        return self

    def scaled(self, value: float) -> tuple[Value, ...]:
        """The robot's parameter for `value`; without a `scale` none.

        Raises:
            ValueError: it is too great for a number, below `minimum` or above `maximum`.
        """
        if self.scale is None:
            return ()
        parameter = value * self.scale + self.offset
        if not math.isfinite(parameter):
            raise ValueError(f"{value} is too great")
        parameter = round(parameter, self.decimals)
        if self.minimum is not None and parameter < self.minimum:
            raise ValueError(f"{parameter:g} is below {self.minimum:g}")
        if self.maximum is not None and parameter > self.maximum:
            raise ValueError(f"{parameter:g} is above {self.maximum:g}")
        return (parameter if self.decimals else int(parameter),)
