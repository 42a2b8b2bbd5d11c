"""Small inputs of first users for which a diagnosis was wrong, with the right answers."""

import numpy as np

from sb3_hds import Trajectories, twins


def joint_with_friction(believed=5.0):
    """A joint of a robot: viscous 22, dry 13, inertia 5; a speed loop, logged by a simulator."""
    rng, dt, obs, torques = np.random.default_rng(0), 0.01, [], []
    for k in range(8):
        t, w, phase = dt * np.arange(800), 0.6 + 0.1 * k, rng.uniform(0, 6)
        q, v, u = np.zeros(801), np.zeros(801), np.zeros(800)
        for i in range(800):
            goal, slope = 0.8 * np.sin(w * t[i] + phase), 0.8 * w * np.cos(w * t[i] + phase)
            u[i] = np.clip(5.0 * slope + 400 * (goal - v[i]), -150, 150)
            v[i + 1] = v[i] + dt * (u[i] - 22.0 * v[i] - 13.0 * np.tanh(v[i] / 0.005)) / 5.0
            q[i + 1] = q[i] + dt * v[i + 1]
        obs.append(np.stack([q, v], 1) + rng.standard_normal((801, 2)) * [3e-5, 3e-3])
        torques.append(u[:, None])
    twin = twins.make("LinearAxis", mass=believed, dt=dt)
    return twin, Trajectories.from_arrays(obs, torques, dt=dt)


def flipped_command():
    """An axis of 2 kg whose command has the wrong sign."""
    rng, dt, obs, commands = np.random.default_rng(0), 0.01, [], []
    for _ in range(8):
        u = 5.0 * np.sin(0.2 * rng.standard_normal(200).cumsum())
        v = np.concatenate([[0.0], np.cumsum(dt * u / 2.0)])
        q = np.concatenate([[0.0], np.cumsum(dt * v[1:])])
        obs.append(np.stack([q, v], 1) + rng.standard_normal((201, 2)) * [1e-4, 3e-3])
        commands.append(-u[:, None])
    return twins.make("LinearAxis", mass=2.0, dt=dt), Trajectories.from_arrays(obs, commands, dt=dt)


def free_pendulum(factor=1.0, zero="down", dry=0.012):
    """Let go: dry friction beside a viscous one that the twin knows; angles as told."""
    rng, h, runs = np.random.default_rng(3), 0.001, []
    total = 0.002 + 0.3 * 0.2**2
    for start in rng.uniform(0.6, 1.4, 8) * rng.choice([-1, 1], 8):
        q, v, seen = start, 0.0, []
        for step in range(6001):
            if step % 20 == 0:
                seen.append(q)
            force = -0.3 * 9.81 * 0.2 * np.sin(q) - 0.001 * v
            sign = np.sign(v) if abs(v) > 1e-3 else np.sign(force)
            if abs(v) <= 1e-3 and abs(force) < dry:
                v = 0.0
            else:
                new = v + h * (force - dry * sign) / total
                v = 0.0 if new * v < 0 else new
            q += h * v
        runs.append(factor * (np.array(seen)[:, None] + 0.003 * rng.standard_normal((301, 1))))
    values = {"mass": 0.3, "com": 0.2, "inertia": 0.002, "damping": 0.001}
    twin = twins.make("FreePendulum", observe="q", zero=zero, dt=0.02, **values)
    return twin, Trajectories.from_arrays(runs, [np.zeros((300, 0))] * 8, dt=0.02)


def scaled_angle():
    """A pendulum whose angle is read 4 % too large, its velocity derived from that reading."""
    rng, dt, h, obs = np.random.default_rng(0), 0.01, 0.001, []
    for _ in range(8):
        q, v, seen = rng.uniform(0.8, 2.6) * rng.choice([-1, 1]), 0.0, []
        for step in range(4001):
            if step % 10 == 0:
                seen.append(q)
            middle = q + h / 2 * v, v + h / 2 * (-40 * np.sin(q) - 0.05 * v)
            q, v = q + h * middle[1], v + h * (-40 * np.sin(middle[0]) - 0.05 * middle[1])
        angle = 1.04 * np.array(seen) + 3e-4 * rng.standard_normal(401)
        obs.append(np.stack([angle, np.gradient(angle, dt)], 1))
    values = {"mass": 1.0, "com": 0.25, "inertia": 0.0, "gravity": 10.0}
    twin = twins.make("FreePendulum", dt=dt, **values)
    return twin, Trajectories.from_arrays(obs, [np.zeros((400, 0))] * 8, dt=dt)


def fast_oscillator(slower=1.0):
    """A spring that hardens (6e5 N/m3) at 68 Hz, logged at 2.4 kHz, in a stretched time."""
    rng, dt, fine, obs, forces = np.random.default_rng(0), slower / 2441.4, 4, [], []
    k, d, k3, h = 1.8e5 / slower**2, 36 / slower, 6e5 / slower**2, dt / fine
    frequency = np.fft.rfftfreq(600, 1 / 2441.4)
    for size in np.linspace(0.4, 2.4, 12):
        spectrum = (frequency > 5) * (frequency < 150) * np.exp(2j * np.pi * rng.random(301))
        u = np.fft.irfft(spectrum, 600)
        u *= size * 3e3 / slower**2 / u.std()
        q, v, seen = 0.0, 0.0, []
        for force in u:
            seen.append([q, v])
            for _ in range(fine):
                a = force - k * q - d * v - k3 * q**3
                qm, vm = q + h / 2 * v, v + h / 2 * a
                q, v = q + h * vm, v + h * (force - k * qm - d * vm - k3 * qm**3)
        rows = np.array(seen)[199:]
        obs.append(rows + rng.standard_normal(rows.shape) * [2e-4, 0.05 / slower])
        forces.append(u[199:-1, None])
    twin = twins.make("Duffing", mass=1.0, damping=d, stiffness=k, cubic_stiffness=0.0, dt=dt)
    return twin, Trajectories.from_arrays(obs, forces, dt=dt)
