/** Server-sent events by `fetch`: unlike EventSource it can send a key, and tells refusals from broken lines. */

/** @typedef {{id: string, event: string, data: string}} Message */

/**
 * The messages of a stream, until it ends.
 * @param {ReadableStream<BufferSource>} body
 * @returns {AsyncGenerator<Message>}
 */
export async function* messages(body) {
  const reader = body.pipeThrough(new TextDecoderStream()).getReader();
  let rest = "";
  try {
    for (;;) {
      const { value, done } = await reader.read();
      if (done) return; // what is left of `rest` was not ended by an empty line: it is no message
      const blocks = (rest + value).replaceAll("\r\n", "\n").split("\n\n");
      rest = blocks.pop() ?? "";
      for (const block of blocks) {
        const message = parse(block);
        if (message) yield message;
      }
    }
  } finally {
    reader.cancel().catch(() => {}); // whoever stops listening ends the connection, too
  }
}

/**
 * @param {string} block
 * @returns {Message | null} null for comments and settings
 */
function parse(block) {
  const message = { id: "", event: "message", data: "" };
  /** @type {string[]} */
  const data = [];
  for (const line of block.split("\n")) {
    const [, field, value] = line.match(/^([^:]*):? ?(.*)$/) ?? [];
    if (field === "data") data.push(value);
    else if (field === "id" || field === "event") message[field] = value;
  }
  message.data = data.join("\n");
  return data.length > 0 ? message : null;
}
