"""Temperatures of the motor: winding, housing and body as a ladder of three heat capacities.

::

    winding --R_wh-- housing --R_hb-- body --R_ba-- ambient
    C_w T_w' = i^2 R(T_w) - (T_w - T_h) / R_wh, and so on outwards

Source: HEBI, X-series motor model (thermal resistances 4.626, 1.0, 8.0 K/W; capacities 0.367, 16.6, 1250 J/K;
limit 155 degC).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from pendulum_msgs_py.errors import ParameterError

__all__ = ["ThermalParameters", "torque_constant_at"]


@dataclass(frozen=True)
class ThermalParameters:
    """Constants of the thermal ladder.

    Attributes:
        winding_housing: Thermal resistance R_wh [K/W].
        housing_body: R_hb [K/W].
        body_ambient: R_ba [K/W].
        winding_capacity: C_w [J/K].
        housing_capacity: C_h [J/K].
        body_capacity: C_b [J/K].
        ambient: Ambient temperature [degC].
        max_winding: Temperature at which the firmware switches the motor off [degC].
        critical_winding: Temperature at which it starts to limit the output [degC].
        magnet_coefficient: Relative change of K_t and K_e per kelvin of the magnets [1/K]. Sm2Co17 loses 0.035 % of its
            flux per kelvin; with copper's 0.4 %/K the shorted-winding damping is then 11.87, 11.76 and 10.84 N m s/rad
            at 20, 22 and 40 degC.
        isothermal: Keep all temperatures constant.
    """

    winding_housing: float = 4.626
    housing_body: float = 1.0
    body_ambient: float = 8.0
    winding_capacity: float = 0.367
    housing_capacity: float = 16.6
    body_capacity: float = 1250.0
    ambient: float = 22.0
    max_winding: float = 155.0
    critical_winding: float = 140.0
    magnet_coefficient: float = -3.5e-4
    isothermal: bool = False

    def __post_init__(self) -> None:
        for name, unit in (
            ("winding_housing", "K/W"),
            ("housing_body", "K/W"),
            ("body_ambient", "K/W"),
            ("winding_capacity", "J/K"),
            ("housing_capacity", "J/K"),
            ("body_capacity", "J/K"),
        ):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ParameterError(f"{name} is {value} {unit}; expected a finite number > 0")
        if not self.critical_winding < self.max_winding:
            raise ParameterError(
                f"critical_winding is {self.critical_winding} degC; "
                f"expected below max_winding = {self.max_winding} degC"
            )


def torque_constant_at(temperature: float, constant: float, coefficient: float) -> float:
    """Return K_t (or K_e) with the magnets, at the housing, at a temperature [degC]: K (1 + beta (T - 20))."""
    return constant * (1.0 + coefficient * (temperature - 20.0))
