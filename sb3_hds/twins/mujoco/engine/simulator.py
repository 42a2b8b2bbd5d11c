"""MuJoCo's engine on batches of NumPy rows: intervals, and their linearisation."""

import copy
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np

from sb3_hds.twins.mujoco.engine.values import Values
from sb3_hds.twins.mujoco.library import mujoco

_EPS = 1e-6  # of finite differences, in units of positions, velocities, commands, forces and scales
_TOLERANCE = 1e-12  # of the solver: the default, 1e-8, shows in finite differences
_MOST_MODELS = 4096  # with other values that are kept

#: ``data`` after an interval to an array
Reading = Callable[[Any], np.ndarray]


class Layout(NamedTuple):
    """
    Sizes of the parts of a row.

    :param nq: position
    :param nv: velocity
    :param nu: commands
    :param n_values: parameters
    :param n_readings: read from the engine after an interval
    """

    nq: int
    nv: int
    nu: int
    n_values: int
    n_readings: int

    @property
    def n_in(self) -> int:
        """Position, velocity, commands, applied generalised force, parameters."""
        return self.nq + 2 * self.nv + self.nu + self.n_values

    @property
    def n_out(self) -> int:
        """Position, velocity, readings."""
        return self.nq + self.nv + self.n_readings

    def n_columns(self, more: bool) -> int:
        """:return: directions of a linearisation, with applied forces and parameters or without"""
        return 2 * self.nv + self.nu + (self.nv + self.n_values if more else 0)


class Simulator:
    """
    Intervals of constant commands. Each begins without a warm start of the solver, so that results
    depend on nothing but the row. One caller at a time; others wait.

    :param values: of the model
    :param scales: of the parameters, for finite differences
    :param timestep: of the engine [s]
    :param n_steps: of the engine in an interval
    :param readings: what to read after each interval
    :param n_readings: their total length
    :param n_threads: default: the processors of this process
    """

    def __init__(
        self,
        values: Values,
        scales: np.ndarray,
        timestep: float,
        n_steps: int,
        readings: Sequence[Reading] = (),
        n_readings: int = 0,
        n_threads: int | None = None,
    ) -> None:
        mj = mujoco()
        nominal = copy.copy(values.nominal)
        nominal.opt.tolerance = _TOLERANCE
        self._values = Values(nominal, values.names)
        self.scales, self.timestep, self.n_steps = scales, timestep, n_steps
        # Time at the start. Where numbers are too large, MuJoCo resets data to time zero, and the
        # interval ends before this.
        self._begin = 2.0 * n_steps * timestep
        self.readings = tuple(readings)
        self.layout = Layout(nominal.nq, nominal.nv, nominal.nu, len(values.names), n_readings)
        self.n_threads = n_threads or _n_processors()
        rk4 = nominal.opt.integrator == mj.mjtIntegrator.mjINT_RK4
        self._linearises = not rk4 and nominal.opt.noslip_iterations == 0
        limited = nominal.actuator_ctrllimited.astype(bool)
        self._high = np.where(limited, nominal.actuator_ctrlrange[:, 1], np.inf)
        self._straight = nominal.nq == nominal.nv
        self._state = mj.mjtState.mjSTATE_FULLPHYSICS.value
        self._control = mj.mjtState.mjSTATE_CTRL.value | mj.mjtState.mjSTATE_QFRC_APPLIED.value
        self._n_state = mj.mj_stateSize(nominal, self._state)
        self._models: dict[bytes, Any] = {}
        self._lock, self._process = threading.Lock(), 0
        self._pool: Any = None
        self._threads: ThreadPoolExecutor | None = None
        self._abandoned: list[Any] = []
        self._start()

    def advance(self, rows: np.ndarray) -> np.ndarray:
        """
        :param rows: shape ``(n, layout.n_in)``
        :return: after an interval, ``(n, layout.n_out)``; nan where a row is not finite or diverges
        """
        with self._lock:
            return self._advance(rows, read=bool(self.readings))

    def linearise(self, rows: np.ndarray) -> np.ndarray:
        """
        :return: after an interval, and its derivatives by position, velocity (in tangent space) and
            commands: ``(n, n_out + 2 nv n_columns)``, the Jacobian ``(2 nv, n_columns)`` row by
            row. That of readings is not computed.
        """
        return self._linearise(rows, more=False)

    def linearise_more(self, rows: np.ndarray) -> np.ndarray:
        """As :meth:`linearise`, by applied forces and parameters too."""
        return self._linearise(rows, more=True)

    def look(self, rows: np.ndarray) -> np.ndarray:
        """:return: the readings at a state that was set, without a step: ``(n, n_readings)``"""
        mj, found = mujoco(), np.full((len(rows), self.layout.n_readings), np.nan)
        with self._lock:
            self._start()
            for i in np.flatnonzero(np.isfinite(rows).all(1)):
                q, v, _, _, values = self._parts(rows[i])
                model, data = self._model(values), self._datas[0]
                mj.mj_resetData(model, data)
                data.qpos[:], data.qvel[:] = q, v
                mj.mj_forward(model, data)
                read = [reading(data).ravel() for reading in self.readings]
                found[i] = np.concatenate(read)
        return found

    def terms(self, rows: np.ndarray) -> np.ndarray:
        """
        :return: mass matrix, row by row, then the generalised forces of gravity, inertia and
            passive elements (``bias``), and of actuators: ``(n, nv nv + 2 nv)``
        """
        mj, nv = mujoco(), self.layout.nv
        found = np.full((len(rows), nv * nv + 2 * nv), np.nan)
        with self._lock:
            self._start()
            for i in np.flatnonzero(np.isfinite(rows).all(1)):
                q, v, u, _, values = self._parts(rows[i])
                model, data = self._model(values), self._datas[0]
                data.qpos[:], data.qvel[:], data.ctrl[:] = q, v, u
                data.qfrc_applied[:] = 0.0
                mj.mj_fwdPosition(model, data)
                mj.mj_fwdVelocity(model, data)
                mj.mj_fwdActuation(model, data)
                matrix = np.empty((nv, nv))
                mj.mj_fullM(model, data, matrix)
                bias = data.qfrc_bias - data.qfrc_passive
                found[i] = np.concatenate([matrix.ravel(), bias, data.qfrc_actuator])
        return found

    # --- several rows

    def _advance(self, rows: np.ndarray, read: bool) -> np.ndarray:
        self._start()
        mj_rows, fine = self._finite(rows)
        out = np.empty((len(rows), self.layout.n_out))
        models = self._models_of(mj_rows)
        if read:
            self._in_threads(lambda i, data: self._step(models[i], data, mj_rows[i], out[i]), out)
        else:
            self._rollout(models, mj_rows, out)
        out[~fine] = np.nan
        return out

    def _linearise(self, rows: np.ndarray, more: bool) -> np.ndarray:
        layout = self.layout
        n_columns = layout.n_columns(more)
        with self._lock:
            self._start()
            if not self._linearises or more:
                return self._differences(rows, n_columns)
            mj_rows, fine = self._finite(rows)
            out = np.empty((len(rows), layout.n_out + 2 * layout.nv * n_columns))
            models = self._models_of(mj_rows)

            def one(i: int, data: Any) -> None:
                self._step_linearised(models[i], data, mj_rows[i], out[i])

            self._in_threads(one, out)
            out[~fine] = np.nan
            return out

    def _rollout(self, models: list[Any], rows: np.ndarray, out: np.ndarray) -> None:
        n, nq, nv = len(rows), self.layout.nq, self.layout.nv
        state = np.zeros((n, self._n_state))
        state[:, 0] = self._begin
        state[:, 1 : 1 + nq + nv] = rows[:, : nq + nv]
        # Commands and applied forces are neighbours in a row, as in MuJoCo's own control vector.
        held = rows[:, nq + nv : nq + nv + self.layout.nu + nv]
        control = np.ascontiguousarray(
            np.broadcast_to(held[:, None], (n, self.n_steps, held.shape[1]))
        )
        states = np.empty((n, self.n_steps, self._n_state))
        sensors = np.empty((n, self.n_steps, self._values.nominal.nsensordata))
        self._pool.rollout(
            models,
            self._datas,
            state,
            control,
            control_spec=self._control,
            skip_checks=True,
            nstep=self.n_steps,
            state=states,
            sensordata=sensors,
        )
        end = states[:, -1]
        out[:, : nq + nv] = end[:, 1 : 1 + nq + nv]
        out[end[:, 0] < self._begin] = np.nan

    def _differences(self, rows: np.ndarray, n_columns: int) -> np.ndarray:
        """One-sided differences of intervals, all in one batch."""
        layout, n = self.layout, len(rows)
        nv, straight, mj = layout.nv, self._straight, mujoco()
        at = layout.nq + nv
        steps = np.full((n, n_columns), _EPS)
        commands = steps[:, 2 * nv : 2 * nv + layout.nu]
        commands[rows[:, at : at + layout.nu] + _EPS > self._high] = -_EPS
        steps[:, 3 * nv + layout.nu :] *= self.scales[: max(0, n_columns - 3 * nv - layout.nu)]
        moved = np.repeat(rows[:, None], n_columns + 1, 1)
        if straight:
            every = np.arange(n_columns)
            moved[:, every + 1, every] += steps
        else:
            model, nq = self._values.nominal, layout.nq
            for j in range(nv):
                direction = np.zeros(nv)
                direction[j] = _EPS
                for row in moved[:, j + 1]:
                    q = np.ascontiguousarray(row[:nq])
                    mj.mj_integratePos(model, q, direction, 1.0)
                    row[:nq] = q
            every = np.arange(nv, n_columns)
            moved[:, every + 1, every + nq - nv] += steps[:, nv:]
        flat = moved.reshape(-1, layout.n_in)
        ends = self._advance(flat, read=False).reshape(n, n_columns + 1, layout.n_out)
        if self.readings:
            ends[:, 0] = self._advance(rows, read=True)
        jacobian = np.empty((n, 2 * nv, n_columns))
        v = ends[:, :, layout.nq : at]
        jacobian[:, nv:] = np.swapaxes((v[:, 1:] - v[:, :1]) / steps[:, :, None], 1, 2)
        q = ends[:, :, : layout.nq]
        if straight:
            jacobian[:, :nv] = np.swapaxes((q[:, 1:] - q[:, :1]) / steps[:, :, None], 1, 2)
        else:
            change = np.empty(nv)
            for i in range(n):
                for j in range(n_columns):
                    mj.mj_differentiatePos(
                        self._values.nominal, change, steps[i, j], q[i, 0], q[i, j + 1]
                    )
                    jacobian[i, :nv, j] = change
        return np.concatenate([ends[:, 0], jacobian.reshape(n, -1)], 1)

    # --- one row

    def _step(self, model: Any, data: Any, row: np.ndarray, out: np.ndarray) -> None:
        mj = mujoco()
        self._set(model, data, row)
        mj.mj_step(model, data, self.n_steps)
        mj.mj_rnePostConstraint(model, data)
        self._read(data, out)

    def _step_linearised(self, model: Any, data: Any, row: np.ndarray, out: np.ndarray) -> None:
        mj, nv, nu = mujoco(), self.layout.nv, self.layout.nu
        A, B = np.empty((2 * nv, 2 * nv)), np.empty((2 * nv, nu))
        self._set(model, data, row)
        by_state, by_command = np.eye(2 * nv), np.zeros((2 * nv, nu))
        for _ in range(self.n_steps):
            mj.mjd_transitionFD(model, data, _EPS, False, A, B, None, None)
            mj.mj_step(model, data)
            by_state, by_command = A @ by_state, A @ by_command + B
        if self.readings:
            mj.mj_rnePostConstraint(model, data)
        self._read(data, out)
        jacobian = np.concatenate([by_state, by_command], 1)
        out[self.layout.n_out :] = jacobian.ravel()

    def _set(self, model: Any, data: Any, row: np.ndarray) -> None:
        mj = mujoco()
        q, v, u, force, _ = self._parts(row)
        state = np.zeros(self._n_state)
        state[0] = self._begin
        state[1 : 1 + len(q)], state[1 + len(q) : 1 + len(q) + len(v)] = q, v
        mj.mj_setState(model, data, state, self._state)
        data.ctrl[:], data.qfrc_applied[:], data.qacc_warmstart[:] = u, force, 0.0

    def _read(self, data: Any, out: np.ndarray) -> None:
        nq, nv = self.layout.nq, self.layout.nv
        out[:nq], out[nq : nq + nv] = data.qpos, data.qvel
        at = nq + nv
        for reading in self.readings:
            found = reading(data).ravel()
            out[at : at + len(found)] = found
            at += len(found)
        if data.time < self._begin:
            out[: self.layout.n_out] = np.nan

    def _parts(self, row: np.ndarray) -> list[np.ndarray]:
        sizes = (self.layout.nq, self.layout.nv, self.layout.nu, self.layout.nv)
        return np.split(row, np.cumsum(sizes))

    # --- models, threads

    def _finite(self, rows: np.ndarray) -> tuple[np.ndarray, Any]:
        """Rows with zeros in place of those that are not finite, and which rows are."""
        fine = np.all(np.isfinite(rows), axis=1)
        if fine.all():
            return rows, fine
        rows = rows.copy()
        rows[~fine] = 0.0
        rows[~fine, self.layout.n_in - self.layout.n_values :] = list(
            self._values.read(self._values.nominal).values()
        )
        return rows, fine

    def _models_of(self, rows: np.ndarray) -> list[Any]:
        n = self.layout.n_values
        values = rows[:, rows.shape[1] - n :]
        if (values == values[:1]).all():
            return [self._model(values[0])] * len(rows)
        return [self._model(row) for row in values]

    def _model(self, values: np.ndarray) -> Any:
        key = values.tobytes()
        if key not in self._models:
            if len(self._models) >= _MOST_MODELS:
                self._models.clear()
            self._models[key] = self._values.model(values, self.timestep)
        return self._models[key]

    def _start(self) -> None:
        """Start the threads, again after a fork, which does not copy them."""
        if self._process == os.getpid():
            return
        from mujoco import rollout

        mj = mujoco()
        # Those of the parent process: to delete them would wait for their threads for ever.
        self._abandoned += [self._pool, self._threads]
        self._process, nominal = os.getpid(), self._values.nominal
        self._datas = [mj.MjData(nominal) for _ in range(self.n_threads)]
        # On one processor, work on the calling thread.
        alone = self.n_threads == 1
        self._pool = rollout.Rollout(nthread=0 if alone else self.n_threads)
        self._threads = None if alone else ThreadPoolExecutor(self.n_threads)

    def _in_threads(self, work: Callable[[int, Any], None], rows: np.ndarray) -> None:
        """:param work: on row ``i`` with an ``MjData``"""

        def share(first: int, data: Any) -> None:
            for i in range(first, len(rows), self.n_threads):
                work(i, data)

        if self._threads is None or len(rows) == 1:
            for i in range(len(rows)):
                work(i, self._datas[0])
            return
        jobs = [self._threads.submit(share, k, data) for k, data in enumerate(self._datas)]
        for job in jobs:
            job.result()


def _n_processors() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
