// The form for a token. It replaces the page if the server refuses the caller, and says why.

import { keepToken, part } from "./page";
import { reasonOf, server } from "./server";

/** Returns whether a reason concerns the caller's identity or rights. */
export function isBarred(reason: string): boolean {
  return reason === "UNAUTHENTICATED" || reason === "ROLE_MISSING";
}

/** Returns title and text for a reason. */
function words(reason: string): [string, string] {
  if (reason === "ROLE_MISSING") {
    const next = "Open the link to a session that somebody else has opened, or use another token.";
    return ["Your token does not let you open a tissue.", next];
  }
  if (server.token) {
    return ["This server does not know your token.", "Copy the whole token again, or ask whoever runs the server for another."];
  }
  return ["This server asks for a token.", "Whoever runs the server can give you one."];
}

export class TokenForm {
  private readonly form = part("token-form", HTMLFormElement);
  private readonly field = part("token-form-token", HTMLInputElement);

  /** `onToken` is called when the user has entered a token. */
  constructor(onToken: () => void) {
    this.form.addEventListener("submit", (event) => {
      event.preventDefault();
      const token = this.field.value.trim();
      if (token === "") return;
      keepToken(token);
      this.field.value = "";
      this.close();
      onToken();
    });
  }

  /** Shows the form in place of the page if a call was refused because of the caller. Returns whether this is so. */
  stops(error: unknown): boolean {
    const reason = reasonOf(error);
    if (!isBarred(reason)) return false;
    this.show(reason);
    return true;
  }

  show(reason: string): void {
    const [what, next] = words(reason);
    part("token-form-what", HTMLElement).textContent = what;
    part("token-form-next", HTMLElement).textContent = next;
    this.form.hidden = false;
    document.body.classList.add("barred");
    this.field.focus();
  }

  private close(): void {
    this.form.hidden = true;
    document.body.classList.remove("barred");
  }
}
