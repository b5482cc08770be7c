# SPDX-License-Identifier: Apache-2.0
"""``diagnose``: from a request to a result. A pure function of picklable arguments.

It may run in a spawned process: it reads only files named in the request and writes none. The pipeline:

1. ``case``: observations, and the vehicle calibrated without any effect (the baseline);
2. ``search``: every effect of the library fitted jointly with vehicle and nuisance parameters;
3. ``judge``: cross-validated evidence, gates and weight of each;
4. ``selection``: the smallest set of effects that closes the gap;
5. ``conclude``: the verdict (made in ``verdict``) and the document.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

from suspension_twin.diagnosis.case import baseline, build, read_case
from suspension_twin.diagnosis.conclude import conclude
from suspension_twin.diagnosis.judge import judge, with_joint_noise
from suspension_twin.diagnosis.request import DiagnosisRequest, DiagnosisResult, Progress
from suspension_twin.diagnosis.selection import select
from suspension_twin.identification.parallel import one_blas_thread

__all__ = ["diagnose"]

#: Longest time step in s: signals differ by 0.2 % of their rms from those in steps of 1 ms.
_STEP = 2.5e-3


def diagnose(
    request: DiagnosisRequest,
    on_progress: Callable[[Progress], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> DiagnosisResult:
    """Diagnose the gap between twin and car: where, why, how sure, and what closes it.

    Parameters
    ----------
    request : DiagnosisRequest
        Twin file and drives.
    on_progress : callable, optional
        Called with a :class:`~suspension_twin.diagnosis.request.Progress`.
    should_stop : callable, optional
        Asked between pieces of work; True ends it.

    Returns
    -------
    DiagnosisResult
        ``document`` is the content of ``diagnosis.json``, ``twin`` the twin with the cause added.

    Raises
    ------
    InputError
        What cannot be used: names file, drive or key.
    WorkError
        A hypothesis cannot be simulated.
    Interrupted
        It was stopped.

    Examples
    --------
    >>> from suspension_twin.diagnosis.request import DiagnosisRequest
    >>> request = DiagnosisRequest(twin="out/calibrated.yaml", bags=("bags/bump_15kmh",))
    >>> diagnose(request).document["verdict"]  # doctest: +SKIP
    'effect'
    """
    began = time.monotonic()
    report = on_progress or (lambda progress: None)
    stop = should_stop or (lambda: False)
    with one_blas_thread():
        report(Progress("reading", 0.0))
        case = read_case(request, lambda note: report(Progress("reading", 0.02, note)), stop)
        bench = replace(build(case, stop), step=_STEP)
        report(Progress("calibrating", 0.08, "the vehicle without any effect"))
        bench, base, anchor = baseline(case, bench)
        if not case.excited:
            bench, base = with_joint_noise(request, case, bench, base)
            anchor = base
        judged = judge(request, case, bench, base, anchor, report)
        found = select(request, case, judged, report)
        report(Progress("judging", 0.95))
        return conclude(request, case, found, time.monotonic() - began)
