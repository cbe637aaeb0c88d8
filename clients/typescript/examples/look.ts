// Watches a tissue that a tool of this page pushes, and shows its depth frame by frame.

import { Field, Frames, Server, Tool } from "palpate";

const told = document.getElementById("told")!;
const server = new Server(location.origin);
const { session } = await server.sessions.createSession({ source: { case: "sceneName", value: "paper" } });
const { sessionId, scene } = session!;

// A frame contains the displacement of every point of the sheet.
const field = new Field(scene!.sheet!.pointsX!, scene!.sheet!.pointsY!);
const frames = new Frames(server);
let deepestM = 0;
frames.onFrame = ({ step }) => {
  for (let i = 2; i < field.displacementM.length; i += 3) deepestM = Math.min(deepestM, field.displacementM[i]!);
  told.textContent = `${frames.taken} frames, step ${step}, deepest ${(1000 * deepestM).toFixed(2)} mm`;
};
frames.run(sessionId, 0, field, new AbortController().signal);

const tool = new Tool(server, sessionId, "look");
const value = { centre: { case: "point", value: { x: 15, y: 15 } }, forceN: { x: 0, y: 0, z: -0.5 } } as const;
await tool.touch(() => ({ action: { case: "force", value } }));
