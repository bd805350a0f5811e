// The interface as openapi.json describes it: routes by topic, then the types that they name.
const at = (id) => document.getElementById(id);

function element(tag, ...children) {
  const made = document.createElement(tag);
  made.append(...children);
  return made;
}

function table(...rows) {
  return element("table", ...rows.map(([first, ...others]) => {
    const head = element("th", first);
    head.scope = "row";
    return element("tr", head, ...others.map((text) => element("td", text)));
  }));
}

// A type in few words; types with a name are described at the end.
function typeOf(schema) {
  if (schema.$ref) {
    const name = schema.$ref.split("/").pop(), link = element("a", name);
    link.href = `#${name}`;
    return link;
  }
  const any = schema.anyOf ?? schema.oneOf;
  if (any) return element("span", ...any.flatMap((one, k) => (k ? [" or ", typeOf(one)] : [typeOf(one)])));
  if (schema.items) return element("span", "list of ", typeOf(schema.items));
  return (schema.enum ?? (schema.const === undefined ? undefined : [schema.const]))?.join(", ") ?? schema.type ?? "any";
}

function bodyOf(content) {
  return element("span", ...Object.entries(content ?? {}).flatMap(([media, { schema }], k) => [k ? "; " : "", `${media}: `, typeOf(schema ?? {})]));
}

function propertiesOf(schema) {
  return Object.entries(schema.properties ?? {}).map(([name, property]) => [name, typeOf(property), property.description ?? ""]);
}

function route(path, method, operation) {
  const rows = (operation.parameters ?? []).map((p) => [p.name, typeOf(p.schema ?? {}), [p.in, p.description].filter(Boolean).join(": ")]);
  const sent = Object.values(operation.requestBody?.content ?? {})[0]?.schema;
  const answers = Object.entries(operation.responses).map(([status, answer]) => [status, answer.description, bodyOf(answer.content)]);
  return element("details",
    element("summary", element("code", `${method.toUpperCase()} ${path}`)),
    element("p", operation.description ?? ""),
    ...(rows.length ? [element("h3", "Parameters"), table(...rows)] : []),
    ...(operation.requestBody ? [element("h3", "Body"), element("p", bodyOf(operation.requestBody.content)), table(...propertiesOf(sent ?? {}))] : []),
    element("h3", "Answers"), table(...answers));
}

function type(name, schema) {
  const made = element("section", element("h3", name), element("p", schema.description ?? ""), table(...propertiesOf(schema)));
  made.id = name;
  return made;
}

async function show() {
  const { info, paths, components } = await (await fetch("openapi.json")).json();
  const topics = new Map();
  for (const [path, operations] of Object.entries(paths))
    for (const [method, operation] of Object.entries(operations)) {
      const topic = operation.tags?.[0] ?? "others";
      topics.set(topic, [...(topics.get(topic) ?? []), route(path, method, operation)]);
    }
  at("version").textContent = info.version;
  at("routes").replaceChildren(
    ...[...topics].map(([topic, routes]) => element("section", element("h2", topic), ...routes)),
    element("section", element("h2", "Types"), ...Object.entries(components?.schemas ?? {}).map((entry) => type(...entry))));
  at("status").textContent = "";
}
show().catch((error) => { at("status").textContent = `openapi.json cannot be read: ${error.message}`; });
