/** Asking for a key where the service wants one. It stays in this tab's session storage. */

import { Problem, json, key, whenUnauthorized } from "./api.js";
import { byId } from "./dom.js";
import { explain, sentence } from "./trouble.js";

/**
 * @param {boolean} required
 * @param {{enter: () => void, leave: () => void}} app
 */
export function gate(required, app) {
  const [field, error] = [byId("gate-key"), byId("gate-error")];

  /** @param {string} text why */
  function shut(text) {
    key.forget();
    app.leave();
    turn(false);
    error.textContent = text;
    field.focus();
  }

  function pass() {
    turn(true);
    app.enter();
  }

  /** @param {boolean} open */
  function turn(open) {
    byId("gate").hidden = open;
    byId("app").hidden = !open;
    byId("forget").hidden = !open || !required;
  }

  byId("forget").addEventListener("click", () => shut(""));
  byId("gate-form").addEventListener("submit", async (/** @type {SubmitEvent} */ event) => {
    event.preventDefault();
    error.textContent = "";
    key.set(field.value.trim());
    try {
      await json("/v1/jobs?limit=1"); // the cheapest question that needs a key
      field.value = "";
      pass();
    } catch (refusal) {
      key.forget();
      const known = refusal instanceof Problem && refusal.code === "unauthorized";
      error.textContent = known ? "This key is not known here." : sentence(explain(refusal).detail);
    }
  });
  whenUnauthorized(() => {
    if (byId("gate").hidden) shut("Your key is not accepted any more.");
  });

  if (required && !key.get()) shut("");
  else pass();
}
