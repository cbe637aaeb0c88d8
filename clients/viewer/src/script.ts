// Plays a script from the server in a session: its commands, stamped with the steps at which they take effect.

import { create } from "@bufbuild/protobuf";
import { type Command, CommandSchema } from "palpate/v1";
import { haptics, CALL_TIMEOUT_MS, sessions, sleep } from "./server";

/** Delay from the start to the first command's step, and how far ahead the others are sent, s. */
const LEAD_S = 0.3;
const AHEAD_S = 1;
/** Maximum number of commands in a message. */
const BATCH = 500;
const LEASE_S = 2;

/** Plays to the end or until it is aborted. Calls `onProgress` with the completed fraction. */
export async function playScript(
  sessionId: string,
  scriptName: string,
  rateHz: number,
  holder: string,
  signal: AbortSignal,
  onProgress: (part: number) => void,
): Promise<string[]> {
  const commands: Command[] = [];
  const warnings: string[] = [];
  let [steps, tools] = [0, 0];
  for await (const part of sessions.getScript({ sessionId, scriptName }, { signal })) {
    commands.push(...part.commands);
    warnings.push(...part.warnings);
    steps = Number(part.steps);
    tools = part.tools;
  }
  const leases: string[] = [];
  const call = { timeoutMs: CALL_TIMEOUT_MS, signal };
  try {
    for (let tool = 0; tool < tools; tool++) {
      const { leaseId } = await haptics.acquireTool({ sessionId, tool, leaseS: LEASE_S, holder }, call);
      leases.push(leaseId);
    }
    const now = async () => Number((await sessions.getSession({ sessionId }, call)).session?.step ?? 0n);
    const begin = (await now()) + Math.ceil(LEAD_S * rateHz);
    let next = 0;
    for (let step = begin; step < begin + steps; step = await now()) {
      const due: Command[] = [];
      const until = step - begin + AHEAD_S * rateHz;
      while (next < commands.length && due.length < BATCH && Number(commands[next]!.atStep) <= until) {
        const command = commands[next++]!;
        due.push(create(CommandSchema, { ...command, atStep: (command.atStep ?? 0n) + BigInt(begin) }));
      }
      // An empty batch renews the lease.
      const batches = leases.map((leaseId, tool) => {
        const own = due.filter((command) => command.tool === tool);
        return haptics.sendCommands({ sessionId, leaseId, commands: own }, call);
      });
      await Promise.all(batches);
      onProgress(Math.max(0, (step - begin) / steps));
      if (due.length < BATCH) await sleep(250, signal);
      if (signal.aborted) break;
    }
  } finally {
    // The tools' actions end with their leases.
    for (const leaseId of leases) {
      await haptics.releaseTool({ sessionId, leaseId }, { timeoutMs: CALL_TIMEOUT_MS }).catch(() => {});
    }
  }
  return warnings;
}
