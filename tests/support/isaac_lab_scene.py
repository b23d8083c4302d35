"""A scene of Isaac Lab: in each of two environments, cloth above a ball. Imports Isaac Lab."""

import contextlib

import isaaclab.sim as sim_utils
import numpy as np
from isaaclab.assets import DeformableObject, DeformableObjectCfg, RigidObject, RigidObjectCfg
from isaaclab.cloner import CloneCfg, clone_plan_from_env_0, replicate
from isaaclab.sim import SimulationCfg, build_simulation_context
from isaaclab_newton.physics import NewtonCfg
from isaaclab_newton.sim.schemas import NewtonDeformableBodyPropertiesCfg
from isaaclab_newton.sim.spawners.materials import NewtonSurfaceDeformableBodyMaterialCfg

_SOFT = {"tri_ke": 1e2, "tri_ka": 1e2, "edge_ke": 1e-4}


@contextlib.contextmanager
def cloth_above_ball(solver_cfg, *, kinematic=True):
    """Yields the simulation, the cloth and the ball, which is kinematic, or rests on the ground."""
    physics = NewtonCfg(solver_cfg=solver_cfg)
    with build_simulation_context(device="cpu", sim_cfg=SimulationCfg(dt=1.0 / 60.0, physics=physics)) as simulation:
        origins = np.float32([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
        sim_utils.create_prim("/World/env_0", "Xform", translation=origins[0])
        body = {"rigid_props": sim_utils.UsdPhysicsRigidBodyCfg(kinematic_enabled=kinematic)}
        body |= {"collision_props": sim_utils.UsdPhysicsCollisionCfg(), "mass_props": sim_utils.MassCfg(mass=0.5)}
        ball = RigidObjectCfg(
            prim_path="/World/env_[^/]+/Ball",
            spawn=sim_utils.SphereCfg(radius=0.1, **body),
            init_state=RigidObjectCfg.InitialStateCfg(pos=(0.0, 0.0, 0.3)),
        )
        material = NewtonSurfaceDeformableBodyMaterialCfg(density=0.2, particle_radius=0.005, **_SOFT)
        shape = {"size": (0.4, 0.4), "edge_refinement": 3}
        deformable = {"deformable_props": NewtonDeformableBodyPropertiesCfg(), "physics_material": material}
        cloth = DeformableObjectCfg(
            prim_path="/World/env_[^/]+/Cloth",
            spawn=sim_utils.MeshRectangleCfg(**shape, **deformable),
            init_state=DeformableObjectCfg.InitialStateCfg(pos=(0.0, 0.0, 0.42)),
        )
        plan = clone_plan_from_env_0(CloneCfg(clone_template="/World/env_{}"), (ball, cloth), 2, 1.0, positions=origins)
        objects = DeformableObject(cfg=cloth), RigidObject(cfg=ball)
        replicate(plan)
        simulation.reset()
        yield simulation, *objects
