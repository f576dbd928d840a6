-- Makes a page, or a part of the PDF, of the Markdown of one executed notebook: captions join what
-- they stand below, labels become links, formulas have numbers, rows of tables are grouped. What would
-- be lost is refused. Options are those of document.py, captions those of docs/notebooks.md.

local stringify = pandoc.utils.stringify
local typst = FORMAT == "typst"
local options
local LOST = {"\\hline", "\\cline", "\\boxed", "\\cancel", "\\color", "\\textcolor", "\\tag"}
local MENDED = { -- TeX that pandoc converts wrongly
  {"\\!", ""}, {"\\;", "\\:"}, {"\\[bB]igg?[lrm]?%s*(\\[lr]?[vV]ert)", "%1"},
  {"\\left%s*\\lVert", "\\lVert"}, {"\\right%s*\\rVert", "\\rVert"},
  {"\\lvert%f[%A]", "\\left\\lvert"}, {"\\rvert%f[%A]", "\\right\\rvert"}}
local SPACED = {"cos", "sin", "ln", "log"} -- MathML by pandoc has no space beside these names
local KINDS = {figure = "figure", figures = "figure", table = "table", tables = "table",
  equation = "equation", equations = "equation", appendix = "appendix", appendices = "appendix"}
local BETWEEN = {["and"] = true, ["or"] = true, ["to"] = true} -- two labels of a kind

local function refuse(reason)
  io.stderr:write("refused: ", options.here, ".ipynb: ", reason, "\n")
  os.exit(1)
end
local function raw(text) return pandoc.RawBlock(FORMAT, text) end
local function as_it_is(element) return element, false end

-- The label of an anchor; those of Typst must be unique in the document.
local function label(chapter, id)
  return typst and ((chapter .. "." .. id):gsub("[^%w%-_.]", "-")) or id
end
local function address(chapter, id)
  local file = not typst and chapter ~= options.here and options.files[chapter] or ""
  return file .. (id == "" and not typst and "" or "#" .. label(chapter, id))
end
local function attributes(id, classes) return pandoc.Attr(label(options.here, id), classes or {}) end

local function picture(image)
  local found, kind, content = pcall(pandoc.mediabag.fetch, image.src)
  if not found or image.src:find "^%a+:" and not image.src:find "^data:" then
    refuse(("expected a picture of the notebook or a file beside it, found '%s'"):format(image.src))
  end
  if not typst then
    if content:find 'id="tip: ' then -- a map whose landmarks can be asked
      local svg = content:match "<svg.*":gsub('<g id="tip: ([^"]*)">', "<g><title>%1</title>")
      return pandoc.RawInline("html", '<label class="zoom"><input type="checkbox"> Enlarge</label>'
        .. '<span class="map" tabindex="0" role="group" aria-label="Map">' .. svg .. "</span>")
    end
    image.src = pandoc.mediabag.make_data_uri(kind, content)
    return image
  end
  local name = pandoc.utils.sha1(content) .. "." .. kind:match "%a+/(%a+)"
  assert(io.open(options.folder .. "/" .. name, "wb")):write(content):close()
  return pandoc.RawInline("typst", ("#picture(%s, %s)"):format(
    pandoc.json.encode(name), pandoc.json.encode(stringify(image.caption))))
end
local function is_picture(block)
  return block.tag == "Para" and #block.content == 1
    and (block.content[1].tag == "Image" or block.content[1].tag == "RawInline")
end
local function caption_of(block)
  if block.tag ~= "Para" then return end
  local kind, number = (stringify(block) .. " "):match "^(%u%l+) ([%dA-Z]+%.?%d*)%.%s"
  if kind == "Figure" or kind == "Table" then return kind:lower(), number end
end

-- The table or the pictures at the end of `blocks`, which are removed there, with their caption, or
-- the caption alone, as where no drive was solved.
local function captioned(blocks, caption, kind, number)
  local above = pandoc.List{}
  while #blocks > 0 and (kind == "figure" and is_picture(blocks[#blocks])
    or kind == "table" and blocks[#blocks].tag == "Table" and #above == 0) do
    above:insert(1, blocks:remove())
  end
  local attr, is_first = attributes(kind .. "-" .. number), true
  local function to_itself(link)
    if is_first then is_first = false; return link.content end
  end
  local text = caption.content:walk{Link = to_itself}
  if #above == 0 then return pandoc.Div({pandoc.Para(text)}, attr) end
  local below = {long = {pandoc.Plain(text)}}
  if kind == "figure" and typst then -- pictures that are narrow enough stand side by side
    local beside = pandoc.Inlines{}
    for _, block in ipairs(above) do beside:extend(block.content) end
    above = {pandoc.Para(beside)}
  end
  if kind == "figure" or not typst then return pandoc.Figure(above, below, attr) end
  above[1].caption, above[1].attr = below, attr
  return above[1]
end

-- A formula for the format of the document; display formulas with their number.
local function formula(math)
  local tag = math.text:match "\\tag%*?%s*{([^{}]*)}"
  math.text = math.text:gsub("%s*\\tag%*?%s*{[^{}]*}", "", 1):gsub("^%s+", ""):gsub("%s+$", "")
  local lost = math.text:match "{array}%s*{[^}]*|"
  for _, name in ipairs(LOST) do lost = lost or math.text:match(name .. "%f[%A]") end
  if lost then refuse(("pandoc would lose %s in this formula:\n    %s"):format(lost, math.text)) end
  local wrong = pandoc.log.silence(pandoc.write, pandoc.Pandoc{pandoc.Plain{math}}, "typst")
  if #wrong > 0 then refuse("pandoc cannot convert this formula:\n    " .. math.text) end
  for _, pair in ipairs(MENDED) do math.text = math.text:gsub(pair[1], pair[2]) end
  for _, name in ipairs(typst and {} or SPACED) do
    math.text = math.text:gsub("([%w}])%s*\\" .. name .. "%f[%A]", "%1\\,\\" .. name)
      :gsub("\\" .. name .. "%s+([%a\\])", "\\" .. name .. "\\, %1")
  end
  if math.mathtype == "InlineMath" then return math end
  local attr = tag and attributes("equation-" .. tag, {"equation"}) or pandoc.Attr("", {"equation"})
  if typst then
    return {pandoc.RawInline("typst", ("#display(%s)["):format(tag and '"(' .. tag .. ')"' or "none")),
      math, pandoc.RawInline("typst", tag and ("]<%s>"):format(attr.identifier) or "]")}
  end
  local number, parts = tag and pandoc.Span("(" .. tag .. ")", {class = "number"}), pandoc.Inlines{}
  for part in (math.text .. "\\qquad"):gmatch "(.-)\\qquad" do -- which may stand on lines of their own
    parts:insert(pandoc.Span({pandoc.Math(math.mathtype, part)}, {class = "keep"}))
  end
  return pandoc.Span({pandoc.Span(parts, {class = "parts"}), number}, attr)
end

-- Text that pandoc writes into a cell of Typst as a numbered list.
local function escaped(str)
  local number = typst and str.text:match "^(%d+)%.$"
  if number then return {pandoc.Str(number), pandoc.RawInline("typst", "\\.")} end
end
local function is_empty(cell) return stringify(cell.contents) == "" end

-- The rows of a table: one that begins with an empty cell continues the group above, and one that
-- holds a name only is the heading of those below it.
local function grouped_rows(rows, columns)
  local first, starts, are_groups = nil, {}, false
  for i, row in ipairs(rows) do
    if first and is_empty(row.cells[1]) then
      first.row_span, are_groups = first.row_span + 1, true
      row.cells:remove(1)
    elseif #row.cells > 1 and #row.cells:filter(is_empty) == #row.cells - 1 then
      row.cells = {row.cells[1]}
      row.cells[1].col_span, first, starts[i] = columns, nil, true
    else
      first, starts[i] = row.cells[1], true
    end
  end
  for i, row in ipairs(rows) do
    if are_groups and i > 1 and starts[i] then
      row.classes = {"group"}
      for _, cell in ipairs(typst and row.cells or {}) do
        cell.attributes["typst:stroke"] = "(top: 0.3pt)"
      end
    end
  end
  return rows
end

-- A table with columns as wide as they must be.
local function grouped(tab)
  tab.colspecs = tab.colspecs:map(function(spec)
    return {spec[1] == "AlignDefault" and "AlignLeft" or spec[1], nil}
  end)
  for _, body in ipairs(tab.bodies) do body.body = grouped_rows(body.body, #tab.colspecs) end
  return tab:walk{Str = escaped}
end

local function answer(quote)
  local box = stringify(quote.content[1]) == "Answer" and pandoc.Div(quote.content, {class = "answer"})
  return box and typst and {raw "#answer[", box, raw "]"} or box or nil
end
local function outside_of_formula(str)
  if str.text:find "^\\begin{" then refuse("a formula stands outside of $$: " .. str.text) end
  if str.text == "$" or str.text:find "%$" and str.text:find "[\\{]" then
    refuse("a formula has braces that do not match, or a blank beside its $: " .. str.text)
  end
end
local function reference(kind, number)
  local id = kind .. "-" .. number
  local chapter = options.targets[id]
  if not chapter then return pandoc.Str(number) end
  return pandoc.Link(number, address(chapter, kind == "appendix" and "" or id))
end

-- References and links: a word with links in place of its labels, and whether more labels may follow.
local function linked_word(text, kind)
  local inlines, position = pandoc.Inlines{}, 1
  while true do
    local first, _, number = text:find("%f[%w]([%dA-Z]%d*%.?%d*)%f[^%w]", position)
    if not first or (not number:find "%d" and kind ~= "appendix") then break end
    number = number:gsub("%.$", "")
    inlines:insert(pandoc.Str(text:sub(position, first - 1)))
    inlines:insert(reference(kind, number))
    position = first + #number
  end
  inlines:insert(pandoc.Str(text:sub(position)))
  return inlines, position > 1 and text:sub(position):find "^,?$"
end

local function references(inlines)
  local result, kind = pandoc.Inlines{}, nil
  for _, inline in ipairs(inlines) do
    local word = inline.tag == "Str" and inline.text
    if not word then
      if inline.tag ~= "Space" and inline.tag ~= "SoftBreak" then kind = nil end
    elseif KINDS[word:lower():gsub("^%p+", "")] then
      kind = KINDS[word:lower():gsub("^%p+", "")]
    elseif kind and not BETWEEN[word] then
      local links, more = linked_word(word, kind)
      kind, inline = more and kind, pandoc.Span(links)
    end
    result:insert(inline)
  end
  return result
end

-- A link of the notebook: to a chapter by its file name, to a heading, or out of the report.
local function resolved(link)
  local name, id = link.target:match "^([^:/#]*)%.ipynb#?(.*)$"
  if not name then name, id = options.here, link.target:match "^#(.+)$" end
  if id and (name == options.here or options.files[name]) then
    link.target = address(name, id)
    return link
  end
  if id and stringify(link):find "^%(" then return {} end -- a remark on what is not in the report
  return (id or typst and not link.target:find "^%a+:") and link.content or link
end

local function with_captions(blocks)
  local result = pandoc.Blocks{}
  for _, block in ipairs(blocks) do
    local kind, number = caption_of(block)
    if kind then
      result:insert(captioned(result, block, kind, number))
    elseif block.tag == "RawBlock" and block.text:find "<table" then
      result:extend(pandoc.read(block.text, "html").blocks:walk{
        Div = function(div) return div.content end, RawInline = function() return {} end, Table = grouped})
    elseif typst and block.tag == "Para" and stringify(block):find ":$" then -- stays with the next
      result:insert(pandoc.Div({block}, {["typst:sticky"] = "true"}))
    else
      if block.tag == "Header" then
        block.attr = attributes((stringify(block):gsub(" ", "-")))
        if typst and stringify(block) == "References" then
          result:insert(raw "#set text(size: 9pt)\n#set par(spacing: 0.7em, leading: 0.5em)")
        end
      end
      result:insert(block)
    end
  end
  return result
end

function Pandoc(doc)
  options = pandoc.json.decode(stringify(doc.meta.options))
  local meta, title = pandoc.Meta(options.page), doc.blocks:remove(1)
  local blocks = doc.blocks:walk{Link = resolved}:walk{
    traverse = "topdown", Header = as_it_is, Link = as_it_is, Inlines = references}
  blocks = with_captions(blocks:walk{Image = picture, Table = grouped, BlockQuote = answer,
    Math = formula, Str = outside_of_formula})
  title = title:walk{Math = formula}
  meta.heading, meta.pagetitle = title.content, stringify(title)
  if typst then blocks:insert(1, pandoc.Header(1, title.content, attributes(""))) end
  return pandoc.Pandoc(blocks, meta)
end
