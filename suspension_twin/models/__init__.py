# SPDX-License-Identifier: Apache-2.0
"""Vehicle models: from a planar pose and a road to the motion of body and wheels and the readings of a sensor.

A model is a file with an object ``MODEL``, found by ``registry``. The way through a car's model: ``excitation``
(the input), ``parameters`` (the twin's numbers as a vector, many candidates side by side), ``car`` and ``constants``
(what the effects change, and the constants of each candidate), ``rows`` (the fields of a block of candidates), the
kernels ``full_car``, ``full_car_effects`` and ``msd``, made of ``corner``, ``curves``, ``equilibrium`` and ``sensor``,
``sensor_chain`` (from the ideal sensor to the real one), ``connectors`` and ``types`` (the output). ``simulate`` runs a
whole drive, ``live`` one stamp at a time with the same numbers; ``one_lane`` gives a lane by itself to ``export``.

``hooks`` describes how an effect changes a model; ``full_car_effects.effect_kernels`` puts the terms of all effects
into the kernel.
"""
