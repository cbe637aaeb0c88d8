// Text of a server, as the page shows it.

/** Letters, at most. */
const MAX_LETTERS = 600;

/** What does something other than to show itself (proto/src/printable.rs): controls, of direction too, and what has no width. */
const ACTS = /[\p{Cc}\u061c\u200b\u200e\u200f\u2028-\u202e\u2060-\u206f\ufeff\ufff9-\ufffb\u{e0000}-\u{e007f}]/gu;

/** A text that may be a server's: each character that acts is `?`, and what is too long to be read is cut. */
export function excerpt(text: string): string {
  const begin = text.length > MAX_LETTERS ? `${text.slice(0, MAX_LETTERS)} …` : text;
  return begin.replace(ACTS, "?");
}
