// The API explorer: swagger-ui, which the page has loaded, with the OpenAPI document of this service.

const { SwaggerUIBundle } = /** @type {any} */ (globalThis);
if (SwaggerUIBundle) SwaggerUIBundle({ url: "/openapi.json", dom_id: "#explorer", deepLinking: true });
