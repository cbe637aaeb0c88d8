// Instruments: the same numbers as the tests of crates/haptics/src/instrument.rs, whose formulas these are, and one that is
// led at a real server.

import assert from "node:assert/strict";
import { test } from "node:test";
import { cross, dot, grasper, Instrument, InstrumentTool, knife, norm, plus, rotated, rotationTo, Server, unit, vec, watchSamples } from "palpate";
import { InstrumentPart, TipShape } from "palpate/v1";
import { Server as Program } from "../../viewer/test/harness.mjs";

/** @typedef {import("palpate").InstrumentPose} InstrumentPose @typedef {import("palpate").Vec3} Vec3 @typedef {import("palpate").Rotation} Rotation */

/** A grasper: a shaft of 40 mm, and jaws of 10 mm. */
function instrument() {
  const tip = { radiusM: 0.002 };
  return new Instrument([-0.01, 0, 0])
    .addRow([-0.01, 0, 0], [-0.05, 0, 0], tip, InstrumentPart.BODY)
    .addRow([-0.008, 0, 0], [0, 0, 0], tip, InstrumentPart.UPPER_JAW)
    .addRow([-0.008, 0, 0], [0, 0, 0], tip, InstrumentPart.LOWER_JAW);
}

/** @param {Rotation} a @param {Rotation} b @returns {Rotation} */
const product = (a, b) => ({
  w: a.w * b.w - a.x * b.x - a.y * b.y - a.z * b.z,
  x: a.w * b.x + a.x * b.w + a.y * b.z - a.z * b.y,
  y: a.w * b.y - a.x * b.z + a.y * b.w + a.z * b.x,
  z: a.w * b.z + a.x * b.y - a.y * b.x + a.z * b.w,
});

/** @param {Vec3} by @returns {Rotation} */
function turn(by) {
  const angle = norm(by);
  const [x, y, z] = plus([0, 0, 0], by, Math.sin(angle / 2) / angle);
  return { w: Math.cos(angle / 2), x, y, z };
}

/** @type {InstrumentPose} */
const POSE = { positionM: [0.1, 0.2, 0.3], orientation: product(turn([0, Math.PI / 2, 0]), turn([0.4, 0, 0])), jawRad: 0.6 };

test("the tips of a row are at most a radius apart, and jaws open to both sides", () => {
  const of = instrument();
  assert.equal(of.tips.length, 21 + 5 + 5);
  const pose = { ...POSE, orientation: { w: 1, x: 0, y: 0, z: 0 } };
  const [upper, lower] = [25, 30].map((tip) => plus(of.tipM(tip, pose), pose.positionM, -1));
  /** @type {Vec3} */
  const expected = [-0.01 + 0.01 * Math.cos(0.3), 0.01 * Math.sin(0.3), 0];
  assert.ok(norm(plus(/** @type {Vec3} */ (upper), expected, -1)) < 1e-15);
  assert.ok(norm(plus(/** @type {Vec3} */ (lower), [expected[0], -expected[1], 0], -1)) < 1e-15);
  assert.ok(norm(plus(of.tipM(0, pose), of.tipM(1, pose), -1)) <= 0.002 + 1e-15);
  assert.deepEqual(of.leads(pose)[30], { radiusM: 0.002, positionM: of.tipM(30, pose) });
});

test("the power of a wrench and of the jaws is that of the forces on the tips", () => {
  const of = instrument();
  /** @type {Vec3} */
  const rotation = [0.3, -0.7, 0.5];
  /** @type {Vec3} */
  const velocity = [0.2, 0.1, -0.4];
  const [opening, dt] = [0.9, 1e-6];
  const after = {
    positionM: plus(POSE.positionM, velocity, dt),
    orientation: product(turn(plus([0, 0, 0], rotation, dt)), POSE.orientation),
    jawRad: POSE.jawRad + opening * dt,
  };
  const forcesN = of.tips.map((_, tip) => /** @type {Vec3} */ ([Math.sin(tip), 0.3, Math.cos(tip)]));
  const moved = (/** @type {number} */ tip) => plus(of.tipM(tip, after), of.tipM(tip, POSE), -1);
  const powerW = forcesN.reduce((sum, forceN, tip) => sum + dot(forceN, moved(tip)) / dt, 0);
  const { forceN, torqueNM } = of.wrench(POSE, forcesN);
  const expectedW = dot(forceN, velocity) + dot(torqueNM, rotation) + of.openingNM(POSE, forcesN) * opening;
  assert.ok(Math.abs(powerW / expectedW - 1) < 1e-5, `${powerW} ${expectedW}`);
  // A tip without a force adds nothing.
  const one = of.wrench(POSE, [undefined, forcesN[1]]);
  assert.deepEqual(one.forceN, forcesN[1]);
  assert.deepEqual(one.torqueNM, cross(plus(of.tipM(1, POSE), POSE.positionM, -1), /** @type {Vec3} */ (forcesN[1])));
});

test("a grasper has the tips that a script gives it", () => {
  const jaws = { lengthM: 0.008, radiusM: 0.0015, friction: 0.6 };
  const of = grasper(jaws, { lengthM: 0.02, radiusM: 0.002, friction: 0.1 });
  assert.deepEqual(of.hingeM, [-0.008, 0, 0]);
  // From 3 mm before the hinge to the end: 5 mm in four gaps; a shaft in ten.
  assert.deepEqual([InstrumentPart.UPPER_JAW, InstrumentPart.LOWER_JAW, InstrumentPart.BODY].map((part) => of.tips.filter((tip) => tip.part === part).length), [5, 5, 11]);
  const first = of.tips[0]?.offsetM ?? assert.fail();
  assert.ok(norm(plus(first, [-0.005, 0, 0], -1)) < 1e-15);
  // Spheres of closed jaws touch each other.
  const spheres = grasper({ ...jaws, shape: TipShape.SPHERE });
  assert.equal(norm(plus(spheres.tipM(0, { ...POSE, jawRad: 0 }), spheres.tipM(5, { ...POSE, jawRad: 0 }), -1)).toFixed(12), "0.003000000000");
});

test("the edge of a knife turns with the instrument", () => {
  // It points down: its edge stands upright on its tip.
  const [lead] = knife(0.02).leads({ positionM: [0.1, 0.2, -0.005], orientation: turn([0, Math.PI / 2, 0]), jawRad: 0 });
  assert.deepEqual(lead?.positionM, [0.1, 0.2, -0.005]);
  assert.equal(lead?.shape, TipShape.BLADE);
  assert.ok(norm(plus(lead?.edgeM ?? assert.fail(), [0, 0, 0.02], -1)) < 1e-15);
});

test("a rotation turns the axes to three vectors, whichever of its components is largest", () => {
  const axes = /** @type {Vec3[]} */ ([[1, 0, 0], [0, 1, 0], [0, 0, 1]]);
  for (const by of /** @type {Vec3[]} */ ([[0.3, 0.2, 0.1], [3, 0.2, 0.1], [0.1, 3, 0.2], [0.2, 0.1, 3], [1.5, -1.5, 1.5]])) {
    const [x, y, z] = /** @type {[Vec3, Vec3, Vec3]} */ (axes.map((axis) => rotated(turn(by), axis)));
    const found = rotationTo(x, y, z);
    for (const v of axes) assert.ok(norm(plus(rotated(found, v), rotated(turn(by), v), -1)) < 1e-12, String(by));
  }
  assert.ok(Math.abs(norm(unit([1, 2, 3])) - 1) < 1e-15);
});

test("an instrument is led by one lease, and feels the sum of the forces on its tips", async () => {
  const program = await Program.start();
  const server = new Server(program.url);
  const { session } = await server.sessions.createSession({ source: { case: "sceneName", value: "liver" } });
  const { sessionId, extent } = session ?? assert.fail();
  const of = grasper({ lengthM: 0.008, radiusM: 0.0015, friction: 0.6 }, { lengthM: 0.01, radiusM: 0.002 });
  const tool = new InstrumentTool(server, sessionId, "a test", of);
  // It lies almost flat, so that several tips of each jaw press.
  const middle = vec(extent?.middleM && { ...extent.middleM, z: 0 });
  const pose = { positionM: plus(middle, [0, 0, -0.002]), orientation: turn([0, 0.1, 0]), jawRad: 0.5 };
  /** Forces on its tools in the first sample in which they satisfy a condition. @param {(forcesN: Vec3[]) => boolean} condition */
  const forces = async (condition) => {
    const ended = new AbortController();
    /** @type {[number, Vec3][]} */
    let found = [];
    await watchSamples(server, sessionId, 10, ({ tools }) => {
      const own = tools.filter((one) => tool.has(one.tool)).map((one) => /** @type {[number, Vec3]} */ ([one.tool, vec(one.forceOnToolN)]));
      if (ended.signal.aborted || !condition(own.map(([, forceN]) => forceN))) return;
      found = own;
      ended.abort();
    }, ended.signal);
    return found;
  };
  assert.ok(await tool.leadTo(pose));
  const pressed = await forces((all) => all.filter((forceN) => forceN[2] > 1e-3).length >= 4);
  assert.equal(pressed.length, of.tips.length);
  const { forceN, torqueNM, openingNM } = tool.felt(pose, pressed);
  const sum = pressed.reduce((sum, [, forceN]) => plus(sum, forceN), /** @type {Vec3} */ ([0, 0, 0]));
  assert.ok(norm(plus(forceN, sum, -1)) < 1e-12 && forceN[2] > 0.01, String(forceN));
  // The jaws lie behind the place of the pose, so that what lifts them turns their ends down.
  assert.ok(torqueNM[1] > 0 && Number.isFinite(openingNM), String(torqueNM));
  // Nobody else gets any of its tools, and all are free afterwards.
  await assert.rejects(server.haptics.acquireTool({ sessionId, tool: of.tips.length - 1, holder: "another" }));
  await tool.letGo();
  await forces((all) => all.every((forceN) => norm(forceN) < 1e-3));
  await server.haptics.acquireTool({ sessionId, tool: of.tips.length - 1, holder: "another" });
  await program.stop();
});
