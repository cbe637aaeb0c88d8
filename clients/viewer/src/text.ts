// Text from a server, as the page shows it.

/** Maximum number of characters. */
const MAX_LETTERS = 600;

/**
 * Characters that have another effect than to be visible (proto/src/printable.rs): control characters, including
 * those for direction, and characters without width.
 */
const ACTS = /[\p{Cc}\u061c\u200b\u200e\u200f\u2028-\u202e\u2060-\u206f\ufeff\ufff9-\ufffb\u{e0000}-\u{e007f}]/gu;

/** Line breaks and tabs, which are spaces on the page. */
const BREAKS = /\s*[\n\r\t]\s*/g;

/** Prepares a text from a server for display: line breaks become spaces, each such character is replaced by `?`, and long texts are cut. */
export function excerpt(text: string): string {
  const begin = text.length > MAX_LETTERS ? `${text.slice(0, MAX_LETTERS)} …` : text;
  return begin.replace(BREAKS, " ").replace(ACTS, "?");
}
