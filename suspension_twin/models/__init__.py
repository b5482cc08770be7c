# SPDX-License-Identifier: Apache-2.0
"""Vehicle models: from a planar pose and a road to what the body, the wheels and a sensor do.

One way through it: ``excitation`` (what drives a model), ``parameters`` (the twin's numbers as a
vector, many candidates side by side), ``constants`` and ``effect_constants`` (what the kernel
needs, per lane), ``rows`` (the fields of a block), ``blocks`` (lanes in blocks of ``rows.WIDTH``), the kernels
``full_car`` and ``full_car_effects`` made of ``corner``, ``curves``, ``damper_tables``, ``equilibrium``
and ``sensor``, then ``observe`` and ``types`` (what comes out). ``simulate`` runs a whole drive,
``live`` one stamp at a time with the same numbers.

``hooks`` describes how an effect changes a model; ``full_car_effects.effect_kernels`` puts the terms of all effects
into the kernel.
"""
