/** The form for a key, if the service requires one. The key is kept in this tab's session storage. */

import { Problem, json, key, whenUnauthorized } from "./api.js";
import { byId } from "./dom.js";
import { explain, sentence } from "./problems.js";

/**
 * @param {boolean} required
 * @param {{enter: () => void, leave: () => void}} app
 */
export function gate(required, app) {
  const [field, error] = [byId("gate-key"), byId("gate-error")];

  /** @param {string} text reason */
  function lock(text) {
    key.forget();
    app.leave();
    show(false);
    error.textContent = text;
    field.focus();
  }

  function unlock() {
    show(true);
    app.enter();
  }

  /** @param {boolean} open */
  function show(open) {
    byId("gate").hidden = open;
    byId("app").hidden = !open;
    byId("forget").hidden = !open || !required;
  }

  byId("forget").addEventListener("click", () => lock(""));
  byId("gate-form").addEventListener("submit", async (/** @type {SubmitEvent} */ event) => {
    event.preventDefault();
    error.textContent = "";
    key.set(field.value.trim());
    try {
      await json("/v1/jobs?limit=1"); // a cheap request that needs the key
      field.value = "";
      unlock();
    } catch (refusal) {
      key.forget();
      const rejected = refusal instanceof Problem && refusal.code === "unauthorized";
      error.textContent = rejected ? "This key is unknown." : sentence(explain(refusal).detail);
    }
  });
  whenUnauthorized(() => {
    if (byId("gate").hidden) lock("Your key is no longer accepted.");
  });

  if (required && !key.get()) lock("");
  else unlock();
}
