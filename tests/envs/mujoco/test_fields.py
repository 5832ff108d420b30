"""What the models of two worlds may differ in is carried, or refused by name: all that MuJoCo keeps, field by field."""

import copy
from operator import attrgetter

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco.introspect import structs

import envs
from envs.base import Entry, Parameter
from envs.mujoco import worlds as physics
from envs.mujoco.engines import CARRIED, POLYNOMIAL, all_fields, comparison, unread
from envs.mujoco.engines import c as engine_c
from envs.mujoco.engines import mjx as engine_jax
from envs.mujoco.engines import warp as engine_warp
from envs.mujoco.scene import Scene, make_env
from envs.mujoco.worlds import PhysicsState
from envs.types import UserError

# Fields that must be the same in all worlds. What is new to MuJoCo has to be put here or into `envs.mujoco.engines`.
REFUSED = """
    B_colind B_rowadr B_rownnz D_colind D_diag D_rowadr D_rownnz M_colind M_rowadr M_rownnz actuator_actadr
    actuator_actearly actuator_actlimited actuator_actnum actuator_armature actuator_biastype actuator_ctrladr
    actuator_ctrllimited actuator_ctrlnum actuator_ctrlspec actuator_damping actuator_dampingpoly actuator_delay
    actuator_dyntype actuator_forcelimited actuator_gaintype actuator_group actuator_history actuator_historyadr
    actuator_outadr actuator_outnum actuator_plugin actuator_trnid actuator_trntype body_conaffinity
    body_contype body_dofadr body_dofnum body_geomadr body_geomnum body_jntadr body_jntnum body_mocapid
    body_parentid body_plugin body_rootid body_simple body_treeid body_weldid dof_Madr dof_bodyid dof_jntid
    dof_parentid dof_simplenum dof_treeid efm0_L efm0_L_colind efm0_L_rowadr efm0_L_rownnz efm0_dofid efmC_perm
    eq_active0 eq_obj1id eq_obj2id eq_objtype eq_type exclude_signature flex_activelayers flex_bending
    flex_bendingadr flex_bvhadr flex_bvhnum flex_cellnum flex_centered flex_conaffinity flex_condim flex_contype
    flex_damping flex_dim flex_edge flex_edgeadr flex_edgedamping flex_edgeequality flex_edgeflap flex_edgenum
    flex_edgestiffness flex_elem flex_elemadr flex_elemdataadr flex_elemedge flex_elemedgeadr flex_elemlayer
    flex_elemnum flex_friction flex_gap flex_interp flex_margin flex_node flex_node0 flex_nodeadr
    flex_nodebodyid flex_nodenum flex_passive flex_priority flex_radius flex_rigid flex_selfcollide flex_shell
    flex_shelldataadr flex_shellnum flex_size flex_solimp flex_solmix flex_solref flex_stiffness
    flex_stiffnessadr flex_vert flex_vert0 flex_vertadr flex_vertbodyid flex_vertedge flex_vertedgeadr
    flex_vertedgenum flex_vertmetric flex_vertnum flexedge_J_colind flexedge_J_rowadr flexedge_J_rownnz
    flexedge_invweight0 flexedge_length0 flexedge_rigid flexvert_J_colind flexvert_J_rowadr flexvert_J_rownnz
    flg_adhesion flg_gravcomp flg_surfacevel geom_adhesion geom_bodyid geom_conaffinity geom_condim geom_contype
    geom_dataid geom_fluid geom_plugin geom_priority geom_surfacevel geom_type hfield_adr hfield_ncol
    hfield_nrow hfield_pathadr hfield_size jnt_actfrclimited jnt_actgravcomp jnt_actuatorid jnt_bodyid
    jnt_dofadr jnt_limited jnt_qposadr jnt_type mapD2M mapM2D mapM2M mesh_bvhadr mesh_bvhnum mesh_extrema
    mesh_face mesh_faceadr mesh_facenormal mesh_facenum mesh_graph mesh_graphadr mesh_normal mesh_normaladr
    mesh_normalnum mesh_octadr mesh_octnum mesh_pathadr mesh_polyadr mesh_polymap mesh_polymapadr
    mesh_polymapnum mesh_polynormal mesh_polynum mesh_polyvert mesh_polyvertadr mesh_polyvertnum mesh_pos
    mesh_quat mesh_scale mesh_vert mesh_vertadr mesh_vertnum nB nC nD nJfe nJfv nJmom nJten nM na nactuator
    narena nbody nbvh nbvhdynamic nbvhstatic nconmax nefm0L nefm0dof nefmCvert nemax neq nexclude nflex
    nflexbending nflexedge nflexelem nflexelemdata nflexelemedge nflexnode nflexshelldata nflexstiffness
    nflexvert ngeom ngravcomp nhfield nhfielddata nhistory njmax njnt nmesh nmeshdegmax nmeshface nmeshgraph
    nmeshnormal nmeshpoly nmeshpolymap nmeshpolyvert nmeshvert nmocap nnumeric nnumericdata noct nout npair
    nplugin npluginattr npluginstate npolygonmax nq nsensor nsensordata nsite ntendon ntree nu numeric_adr
    numeric_data numeric_size nuserdata nv nwrap oct_aabb oct_child oct_coeff oct_depth opt.ccd_iterations
    opt.ccd_tolerance opt.cone opt.disableactuator opt.disableflags opt.enableflags opt.integrator
    opt.iterations opt.jacobian opt.ls_iterations opt.ls_tolerance opt.noslip_iterations opt.noslip_tolerance
    opt.o_friction opt.o_margin opt.o_solimp opt.o_solref opt.sdf_initpoints opt.sdf_iterations
    opt.sleep_tolerance opt.solver opt.timestep opt.tolerance pair_adhesion pair_dim pair_geom1 pair_geom2
    pair_signature plugin plugin_attr plugin_attradr plugin_stateadr plugin_statenum sensor_adr sensor_cutoff
    sensor_datatype sensor_delay sensor_dim sensor_history sensor_historyadr sensor_interval sensor_intprm
    sensor_needstage sensor_noise sensor_objid sensor_objtype sensor_plugin sensor_refid sensor_reftype
    sensor_type site_bodyid site_dataid site_size site_type ten_J_colind ten_J_rowadr ten_J_rownnz
    tendon_actfrclimited tendon_actuatorid tendon_adr tendon_limited tendon_num tendon_treeid tendon_treenum
    tree_bodyadr tree_bodynum tree_dofadr tree_dofnum tree_sleep_policy wrap_objid wrap_prm wrap_type
"""
RICH = """
<mujoco>
  <option timestep="0.005" density="30" viscosity="0.3" wind="1 0.5 0.2" magnetic="0.1 0.2 -0.5" impratio="2"
    gravity="0.3 0.2 -9.81" cone="elliptic" iterations="30" ls_iterations="20"/>
  <asset><material name="paint" rgba="0.3 0.4 0.5 1"/></asset>
  <default><geom solimp="0.8 0.9 0.01 0.5 2" solref="0.03 1"/></default>
  <worldbody>
    <geom name="floor" type="plane" size="2 2 .1" friction="0.8 0.01 0.001" margin="0.01" material="paint"/>
    <camera name="eye" pos="0 -2 1" xyaxes="1 0 0 0 0.5 1"/>
    <body pos="0 0 0.1">
      <freejoint/><geom name="ball" size="0.1" mass="1" condim="6" margin="0.01"/><site name="skin" size="0.2"/>
    </body>
    <body pos="1 0 0.1" gravcomp="0.2">
      <joint name="x" type="slide" axis="1 0 0.1" stiffness="20" springref="0.2" damping="0.5" armature="0.1"
        frictionloss="0.3" range="-0.005 0.005" margin="0.002" pos="0.01 0 0"/>
      <geom type="box" size="0.1 0.08 0.05" mass="0.7" pos="0.01 0 0.02" euler="10 5 0"/>
      <body pos="0.2 0 0.1" euler="0 10 0">
        <joint name="y" axis="0 1 0.1" pos="0.01 0.02 0" damping="0.1" actuatorfrcrange="-0.4 0.4"/>
        <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" mass="0.4"/><site name="tip" pos="0.3 0 0.01"/>
      </body>
    </body>
    <body pos="1.1 0.5 0.3">
      <joint name="z" axis="0 0 1" damping="0.05"/><geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" mass="0.4"/>
      <site name="end" pos="0.3 0 0"/>
    </body>
    <body pos="0.6 0.5 0.06">
      <joint type="slide" axis="0 0 1"/><geom name="weight" size="0.07" mass="0.3" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <contact>
    <pair geom1="weight" geom2="floor" solref="0.03 1" condim="3" margin="0.02" solimp="0.8 0.9 0.01 0.5 2"/>
  </contact>
  <tendon>
    <spatial name="rope" stiffness="5" damping="0.3" springlength="0.1 0.2" armature="0.05" frictionloss="0.1"
      range="0.1 0.45" margin="0.01" actuatorfrcrange="-0.3 0.3"><site site="tip"/><site site="end"/></spatial>
  </tendon>
  <equality><joint joint1="z" joint2="y" polycoef="0.05 0.3 0 0 0" solref="0.05 1" solimp="0.7 0.9 0.1"/></equality>
  <actuator>
    <motor joint="x" gear="3" ctrlrange="-0.4 0.4" forcerange="-1 1"/><position joint="y" kp="4" kv="0.3" gear="1.5"/>
    <motor tendon="rope" gear="2"/>
  </actuator>
  <sensor>
    <touch site="skin"/><rangefinder site="tip"/><camprojection site="tip" camera="eye"/><magnetometer site="tip"/>
  </sensor>
</mujoco>
"""
SMALL = """
<mujoco>
  <option timestep="0.01" density="1" viscosity="0.1" wind="3 0 0"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 .1"/>
    <body name="b" pos="0 0 0.3">
      <joint name="z" type="slide" axis="0 0 1"/><joint name="x" type="slide" axis="1 0 0"/>
      <geom name="g" size="0.1" mass="1"/><site name="s" euler="10 20 0"/>
    </body>
  </worldbody>
  <actuator><motor name="m" joint="x" ctrlrange="-1 1"/></actuator>
  <sensor><magnetometer site="s"/></sensor>
</mujoco>
"""
SLOW = [pytest.param(x, marks=pytest.mark.slow) for x in ("jax", *(["warp"] if engine_warp.available() else []))]


def scene(change, mjcf=SMALL, *parameters):
    """A ball that falls and is pushed; `change(spec, theta)` is what parameters called x, or as given, mean."""

    def build(theta):
        spec = mujoco.MjSpec.from_string(mjcf)
        change(spec, theta)
        return spec

    return Scene(
        name="ball",
        observation=(Entry("q", "m", 2),),
        action=(Entry("u", "N", 1),),
        parameters=parameters or (Parameter("x", "", 1.0, 0.5, 2.0),),
        episode_length=9,
        control_dt=0.5,
        substeps=50,
        build=build,
        initial=lambda p, key: PhysicsState(jnp.zeros(2), jnp.zeros(2), jnp.zeros(2), jnp.zeros(1)),
        target=lambda q, a: a,
        observe=lambda p, s: s.qpos,
        reward=lambda o, a, n: n[0],
        score="return",
        max_speed=1e3,
    )


def true_motion(model):
    """[nq + nv + nsensordata] after a control period of `scene` in MuJoCo itself."""
    data = mujoco.MjData(model)
    data.ctrl[:] = 1
    for _ in range(50):
        mujoco.mj_step(model, data)
    return np.concatenate([data.qpos, data.qvel, data.sensordata])


def motions(task, impl, values):
    """[len(values), ...] what the engine makes of the same period, and MuJoCo. values: thetas by name."""
    env, rows = make_env(task, impl), []
    step = jax.jit(env.step)
    for theta in values:
        pool = envs.sample_worlds(env, jax.random.key(0), 1, params=theta)
        world = jax.tree.map(lambda x: x[0], pool)
        with jax.numpy_rank_promotion("allow"):  # MJX broadcasts matrices against vectors
            after = step(world, env.reset(world, jax.random.key(1)), jnp.ones(1), jax.random.key(2)).physics
        rows.append(np.concatenate([after.qpos, after.qvel, after.sensordata]))
    return np.array(rows), np.array([true_motion(task.build(theta).compile()) for theta in values])


# --- every field ----------------------------------------------------------------------------------------------------


def test_every_field_of_mujoco_is_carried_unread_or_refused():
    plain = mujoco.MjModel.from_xml_string("<mujoco/>")
    names = list(all_fields())
    of_mujoco = {
        start + getattr(field, "name", "")
        for struct, start in (("mjModel", ""), ("mjOption", "opt."), ("mjStatistic", "stat."))
        for field in structs.STRUCTS[struct].fields
    }
    assert of_mujoco - {"opt", "stat", "buffer"} <= set(names)
    rest = {name for name in names if name not in CARRIED and not name.startswith(unread(plain))}
    assert rest == set(REFUSED.split())
    assert set(CARRIED) <= set(names)


def test_mjx_has_an_array_of_whatever_it_carries():
    """But for the margin of bodies, which only C MuJoCo reads, and what it refuses by name."""
    model = engine_jax.put(mujoco.MjModel.from_xml_string(SMALL))[0]
    constant = {name for name in CARRIED if not isinstance(attrgetter(name)(model), jax.Array)}
    assert constant == {"body_margin"}


@pytest.fixture(scope="module")
def rich():
    """A model with nearly everything, a state of it and commands [steps, nu]."""
    host = mujoco.MjModel.from_xml_string(RICH)
    data, rng = mujoco.MjData(host), np.random.default_rng(0)
    for _ in range(5):
        data.ctrl[:] = rng.uniform(-1, 1, host.nu)
        mujoco.mj_step(host, data)
    qpos, qvel, warmstart, ctrl = map(jnp.float32, (data.qpos, data.qvel, data.qacc_warmstart, data.ctrl))
    state = PhysicsState(qpos, qvel, warmstart, ctrl, jnp.zeros(host.nsensordata))
    return host, state, jnp.asarray(rng.uniform(-1, 1, (3, host.nu)), jnp.float32)


def changed(host, name):
    """The model with other values in that field, and these."""
    model, old = copy.deepcopy(host), np.asarray(attrgetter(name)(host), np.float64)
    new = np.float32(np.clip(0.97 * old, 0, 0.99) if "solimp" in name else 1.1 * old + 0.01 * (np.abs(old).max() or 1))
    part, _, last = name.rpartition(".")
    owner = getattr(model, part) if part else model
    if isinstance(getattr(owner, last), np.ndarray):
        getattr(owner, last)[...] = new.reshape(getattr(owner, last).shape)
    else:
        setattr(owner, last, float(new))
    return model, new


def test_a_changed_field_does_in_c_what_it_does_in_mujoco(rich):
    host, state, controls = rich
    names = [name for name in CARRIED if np.size(attrgetter(name)(host))]
    nominal = {name: jnp.asarray(attrgetter(name)(host), jnp.float32) for name in names}
    advance = jax.jit(engine_c.make_engine(host, tuple(names)).advance)

    def true(model):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = state.qpos, state.qvel, state.warmstart
        for row in np.asarray(controls):
            data.ctrl[:] = row
            mujoco.mj_step(model, data)
        return np.concatenate([data.qpos, data.qvel, data.sensordata])

    host.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_MIDPHASE
    before, moving = true(host), set()
    for name in names:
        model, value = changed(host, name)
        after = advance(nominal | {name: jnp.asarray(value)}, state, controls)
        seen, wanted = np.concatenate([after.qpos, after.qvel, after.sensordata]), true(model)
        np.testing.assert_allclose(seen, wanted, rtol=1e-4, atol=1e-4, err_msg=name)
        moving |= {name} if np.abs(wanted - before).max() > 1e-5 else set()
    assert len(moving) >= 50 and {"opt.wind", "opt.density", "opt.viscosity", "opt.magnetic", "cam_pos"} <= moving


def test_what_a_comparison_names():
    host = mujoco.MjModel.from_xml_string(SMALL)
    differing = comparison(host, ("geom_size",))
    other = copy.deepcopy(host)
    assert differing(other) == []
    other.geom_size[0, 0], other.geom_rgba[0], other.geom_friction[0, 0] = 7.0, 0.3, 2.0
    other.opt.noslip_iterations, other.body_mass[1] = 3, host.body_mass[1] * (1 + 1e-8)
    assert differing(other) == ["geom_friction", "opt.noslip_iterations"]
    assert differing(mujoco.MjModel.from_xml_string(SMALL.replace("<site", '<geom size="1"/><site')))[0].startswith("n")


# --- carried --------------------------------------------------------------------------------------------------------


@pytest.mark.heavy
@pytest.mark.parametrize("impl", ["c", *SLOW])
def test_fluids_gravity_and_magnets_differ_between_worlds(impl):
    """Also where the nominal scene has none of them: MJX and Warp would leave their code out."""
    mjcf = SMALL.replace('density="1" viscosity="0.1" wind="3 0 0"', 'density="0"')
    names = ("wind", "density", "viscosity", "gravity", "magnetic", "impratio")

    def change(spec, theta):
        option = spec.option
        option.wind, option.density, option.viscosity = [theta["wind"], 0, 0], theta["density"], theta["viscosity"]
        option.gravity, option.magnetic = [0, 0, -theta["gravity"]], [0, theta["magnetic"], 0]
        option.impratio = theta["impratio"]

    zero = {"gravity": 5.0, "impratio": 1.0}
    parameters = (Parameter(n, "", zero.get(n, 0.0), zero.get(n, 0.0), 9.0, maximum=1e3) for n in names)
    still = {n: zero.get(n, 0.0) for n in names}
    others = (
        {"density": 500.0, "wind": 3.0},
        {"density": 900.0},
        {"viscosity": 2.0},
        {"gravity": 9.0},
        {"magnetic": 4.0},
        {"impratio": 5.0},
    )
    seen, wanted = motions(scene(change, mjcf, *parameters), impl, [still, *(still | other for other in others)])
    np.testing.assert_allclose(seen, wanted, rtol=1e-3, atol=1e-3)
    assert (np.abs(wanted[1:] - wanted[0]).max(1) > 1e-4).all()


def test_a_margin_reaches_the_contacts():
    """C MuJoCo keeps the largest margin of a body beside those of its geoms."""

    def change(spec, theta):
        spec.geom("g").margin = 0.1 * theta["x"]
        spec.geom("floor").margin = 0.01

    mjcf = SMALL.replace('timestep="0.01"', 'timestep="0.01" gravity="0 0 0"').replace('mass="1"', 'mass="1" gap="0"')
    seen, wanted = motions(scene(change, mjcf), "c", [{"x": 0.5}, {"x": 2.0}])
    np.testing.assert_allclose(seen, wanted, atol=1e-5)


def test_frames_and_boxes_of_the_nominal_scene_are_not_taken_for_those_of_a_world():
    """A body whose centre of mass and geoms move away from where the nominal scene has them."""
    mjcf = SMALL.replace(
        '<joint name="x" type="slide" axis="1 0 0"/>', '<joint name="x" type="hinge" axis="0 1 0" pos="0 0 .1"/>'
    ).replace('mass="1"/>', 'mass="1"/>' + "".join(f'<geom size=".02" pos=".3 {y} 0"/>' for y in (0, 0.1, 0.2, 0.3)))

    def change(spec, theta):
        spec.geom("g").pos = [0, 0, theta["x"] - 1.0]
        for geom in spec.geoms[2:]:
            geom.pos = [0.3, geom.pos[1], -0.2 * (theta["x"] - 1.0)]

    seen, wanted = motions(scene(change, mjcf), "c", [{"x": 1.0}, {"x": 1.3}, {"x": 0.8}])
    np.testing.assert_allclose(seen, wanted, rtol=1e-3, atol=1e-3)


# --- refused --------------------------------------------------------------------------------------------------------


def option(name, value):
    return lambda spec, theta: setattr(spec.option, name, value(theta["x"]))


def cutoff(spec, theta):
    spec.sensors[0].cutoff = theta["x"]


def collisions(spec, theta):
    spec.geom("g").contype = 1 if theta["x"] <= 1 else 3


@pytest.mark.parametrize(
    ("change", "field"),
    [
        (option("timestep", lambda x: 0.01 * x), "opt.timestep"),
        (option("o_margin", lambda x: x), "opt.o_margin"),
        (option("tolerance", lambda x: 1e-8 * x), "opt.tolerance"),
        (option("iterations", lambda x: 10 if x <= 1 else 20), "opt.iterations"),
        (option("disableflags", lambda x: 0 if x <= 1 else 1 << 5), "opt.disableflags"),
        (option("integrator", lambda x: 0 if x <= 1 else 3), "opt.integrator"),
        (cutoff, "sensor_cutoff"),
        (collisions, "geom_contype"),
        (lambda spec, theta: setattr(spec.geom("g"), "surfacevel", [theta["x"], 0, 0, 0, 0, 0]), "geom_surfacevel"),
        (lambda spec, theta: setattr(spec.geom("g"), "adhesion", theta["x"]), "geom_adhesion"),
        (lambda spec, theta: setattr(spec.actuators[0], "damping", [theta["x"], 0, 0]), "actuator_damping"),
        (lambda spec, theta: setattr(spec.joint("x"), "type", 2 if theta["x"] <= 1 else 3), "jnt_type"),
        (lambda spec, theta: theta["x"] > 1 and spec.worldbody.add_geom(size=[1, 0, 0]), "ngeom"),
        (lambda spec, theta: setattr(spec.geom("g"), "fluid_ellipsoid", theta["x"] > 1), "geom_fluid"),
    ],
)
def test_what_no_engine_carries_is_refused_by_name_when_the_task_is_made(change, field):
    with pytest.raises(UserError, match=rf"scene ball: domain parameters change .*'{field}'.* of the scene; they may"):
        make_env(scene(change), "c")


def test_a_camera_counts_where_a_sensor_looks_through_it():
    host = mujoco.MjModel.from_xml_string(RICH)
    assert physics.carried(host)[-1] != "geom_rgba" and {"cam_pos", "geom_rgba", "mat_rgba"} <= {*physics.carried(host)}
    assert not {"cam_pos", "geom_rgba", "mat_rgba"} & {*physics.carried(mujoco.MjModel.from_xml_string(SMALL))}


@pytest.mark.parametrize(
    ("mass", "words"),
    [
        (lambda x: 1 + max(0.0, x - 1.5), None),  # found at the end of the range
        (lambda x: int(3 * x), None),
        (lambda x: 1 + max(0.0, x - 3), "'body_mass', .* but not near their nominal values"),
    ],
)
def test_what_acts_only_far_from_the_nominal_value_is_carried_or_refused(mass, words):
    env = make_env(scene(lambda spec, theta: setattr(spec.geom("g"), "mass", mass(theta["x"]))), "c")
    if words is None:
        world = envs.sample_worlds(env, jax.random.key(0), 1, params={"x": 2.0})
        assert world.model["body_mass"][0, 1] == mass(2.0)
        return
    with pytest.raises(UserError, match=words):
        envs.sample_worlds(env, jax.random.key(0), 1, params={"x": 4.0})


def test_what_mjx_takes_from_the_nominal_scene_is_refused_there():
    fast = SMALL.replace("<option", '<option integrator="implicitfast"').replace('density="1" viscosity="0.1"', "")
    thick = scene(lambda spec, theta: setattr(spec.option, "density", theta["x"]), fast.replace('wind="3 0 0"', ""))
    zero = Parameter("x", "", 0.0, 0.0, 2.0)
    curved = scene(lambda spec, theta: setattr(spec.joint("x"), "stiffness", [0, theta["x"], 0]), SMALL, zero)
    for task, words in ((thick, "'opt.density' need the engine c .*implicitfast"), (curved, POLYNOMIAL[0])):
        assert make_env(task, "c").impl == "c"
        with pytest.raises(UserError, match=words):
            make_env(task, "jax")
