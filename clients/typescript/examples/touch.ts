// Presses a tip into a tissue, and shows how hard the tissue pushes back.

import { norm, Server, Tool, vec, watchSamples } from "palpate";
import type { Sample } from "palpate/v1";

const told = document.getElementById("told")!;
const server = new Server(location.origin);
const { session } = await server.sessions.createSession({ source: { case: "sceneName", value: "liver" } });
const { sessionId, scene } = session!;
const { pointsX = 0, pointsY = 0, spacingM = 0 } = scene!.sheet!;

let mostN = 0;
const onSample = ({ step, tools }: Sample) => {
  mostN = Math.max(mostN, norm(vec(tools[0]?.forceOnToolN)));
  told.textContent = `step ${step}, at most ${mostN.toFixed(3)} N`;
};
void watchSamples(server, sessionId, 10, onSample, new AbortController().signal);

// Moves from 2 cm above the middle of the sheet to 4 mm below it within a second. Only the newest position counts.
const tool = new Tool(server, sessionId, "touch");
const [x, y] = [0.5 * (pointsX - 1) * spacingM, 0.5 * (pointsY - 1) * spacingM];
const begunMs = performance.now();
await tool.touch((nowMs) => {
  const part = Math.min(1, (nowMs - begunMs) / 1000);
  return { leads: [{ positionM: [x, y, 0.02 - 0.024 * part], radiusM: 0.005 }], isMoving: part < 1 };
});
