-- Makes the report of one notebook of all chapters: numbers sections, figures and tables without gaps,
-- makes links of references, and leaves out what the options say. As HTML it writes a page for each
-- chapter into options.folder, else it returns the document for Typst and writes its pictures there.
-- Captions, references and tags are those of docs/notebooks.md, options those of document.py.

local stringify = pandoc.utils.stringify
local typst = FORMAT == "typst"
local options, chapters, by_name = nil, pandoc.List{}, {}
local targets = {} -- of references, by "figure 2.3": chapter, id and new number
local known = {} -- references that may lead nowhere, because a section is left out
local place = "" -- begins the sentences of errors
local LOST = {"\\hline", "\\cline", "\\boxed", "\\cancel", "\\color", "\\textcolor", "\\tag"}
local MENDED = { -- TeX that pandoc converts wrongly
  {"\\!", ""}, {"\\;", "\\:"}, {"\\[bB]igg?[lrm]?%s*(\\[lr]?[vV]ert)", "%1"},
  {"\\left%s*\\lVert", "\\lVert"}, {"\\right%s*\\rVert", "\\rVert"},
  {"\\lvert%f[%A]", "\\left\\lvert"}, {"\\rvert%f[%A]", "\\right\\rvert"}}
local KINDS = {figure = "figure", figures = "figure", table = "table", tables = "table",
  equation = "equation", equations = "equation", appendix = "appendix", appendices = "appendix"}

local function tell(sentence)
  if not typst and not options.check then io.stderr:write(sentence, "\n") end
end

local function refuse(reason, code)
  io.stderr:write("refused: ", place, reason, "\n")
  os.exit(code or 1)
end

local function raw(text) return pandoc.RawBlock(FORMAT, text) end

-- The text of a heading or a paragraph without its formulas.
local function plain(block)
  return (stringify(block:walk{Math = function() return {} end}):gsub("\u{a0}", " "):gsub("%s+$", ""))
end

-- The address of an anchor, "" for the whole chapter; labels of Typst must be unique in the document.
local function address(chapter, id, here)
  if typst then return (("#%s.%s"):format(chapter.name, id):gsub("[^%w%-_.#]", "-")) end
  local file = chapter ~= here and chapter.file or ""
  return file .. (id == "" and "" or "#" .. id)
end

local function attributes(chapter, id, classes)
  chapter.ids[id] = true
  return pandoc.Attr(typst and address(chapter, id):sub(2) or id, classes or {})
end

-- 1. Cells to chapters.

local function has_tag(cell, tag)
  return (cell.attributes.tags or ""):find('"' .. tag .. '"', 1, true)
end

local function picture(image, alt)
  local kind, content = pandoc.mediabag.lookup(image.src)
  if not content and not image.src:find "^%a+:" then
    kind, content = pandoc.mediabag.fetch(image.src) -- a file beside the notebook
  end
  if not content then
    refuse(("expected a picture of the notebook or a file beside it, found '%s'"):format(image.src))
  end
  if not typst then
    image.src, image.caption = pandoc.mediabag.make_data_uri(kind, content), {pandoc.Str(alt)}
    return image
  end
  local name = image.src:gsub("[^%w.]", "-")
  assert(io.open(options.folder .. "/" .. name, "wb")):write(content):close()
  return pandoc.RawInline("typst", ("#picture(%s, %s)"):format(
    pandoc.json.encode(name), pandoc.json.encode(alt)))
end

local function code(block, hidden)
  if options.code == "none" or block.text == "" or (typst and hidden) then return {} end
  if not hidden then return {block} end
  return {pandoc.Div({raw "<details><summary>Code</summary>", block, raw "</details>"}, {class = "folded"})}
end

-- The blocks that a cell shows.
local function shown(cell, chapter)
  local hidden = options.code == "method" and has_tag(cell, "hide-input")
  local blocks = pandoc.Blocks{}
  for _, block in ipairs(cell.content) do
    if block.tag == "CodeBlock" and cell.classes:includes "code" then
      blocks:extend(code(block, hidden))
    elseif block.tag == "Div" and block.classes:includes "output" then
      for _, output in ipairs(block.content) do
        if output.tag ~= "CodeBlock" then
          blocks:insert(output)
        elseif options.code ~= "none" then
          output.classes = {"output", block.classes[#block.classes]}
          output.text = output.text:gsub("\27%[[%d;]*m", "") -- colours of a terminal
          blocks:insert(output)
        end
      end
    elseif block.tag == "RawBlock" and block.text:find "<table" then
      blocks:extend(pandoc.read(block.text, "html").blocks:walk{
        Div = function(div) return div.content end})
    else
      blocks:insert(block)
    end
  end
  return blocks:walk{Image = function(image)
    chapter.pictures = chapter.pictures + 1
    return picture(image, cell.attributes.alt or ("Figure %d of this chapter, described in the text")
      :format(chapter.pictures))
  end}
end

-- Before the execution, headings in place of the code that will show them.
local function announced(chapter, text)
  for level, title in text:gmatch "[\"'](###?) +([^\"'\\\n]+)" do
    chapter.items:insert{block = pandoc.Header(#level, title)}
  end
end

local function read_cells(blocks)
  for _, cell in ipairs(blocks) do
    local name, chapter = cell.attributes.chapter, chapters[#chapters]
    if name then
      chapter = {name = name, file = name:gsub(" ", "%%20") .. ".html", items = pandoc.List{},
        ids = {[""] = true}, gone = {}, pictures = 0, title = name, heading = {pandoc.Str(name)}}
      chapters:insert(chapter)
      by_name[name] = chapter
      place = name .. ".ipynb: "
    else
      local notes = cell.attributes.slamlib and pandoc.json.decode(cell.attributes.slamlib) or {}
      local off = typst and has_tag(cell, "html-only")
      if options.check and cell.classes:includes "code" and cell.content[1] then
        announced(chapter, cell.content[1].text)
      end
      for _, block in ipairs(shown(cell, chapter)) do
        if block.tag == "Header" and block.level == 1 and not chapter.number then
          chapter.title, chapter.heading = stringify(block), block.content
          chapter.number = chapter.title:match "^(%d+)%." or chapter.title:match "^(%u)%."
        else
          chapter.items:insert{block = block, off = off, needs = notes.needs}
        end
      end
    end
  end
end

-- 2. Sections: which are shown, and their numbers.

local found, sections = {}, pandoc.List{}

local function key(name) return ((name or ""):gsub("%.$", ""):lower()) end

-- Why a section is left out: "" without a reason that must be told, nil if it is shown.
local function reason(number, title, needs)
  sections:insert((number and number .. " " or "") .. title)
  if needs and not options.has:find(needs) then return "no dataset has " .. needs end
  for name, where in pairs(options.leave_out) do
    if key(name) == key(number) or key(name) == key(title) then
      found[name] = true
      return where
    end
  end
end

local function require_found()
  for name, where in pairs(options.leave_out) do
    if where ~= "" and not (found[name] or name:find "^%d+$" or name:find "^%a$") then -- a chapter
      place = where .. ": "
      refuse(("expected to leave out a chapter or a section (%s), found '%s'"):format(
        table.concat(sections, ", "), name))
    end
  end
end

local function counted(counts, level)
  counts[level - 1] = counts[level - 1] + 1
  if level == 2 then counts[2] = 0 end
  return table.concat(counts, ".", 1, level - 1)
end

local function number_sections(chapter)
  local all, kept, left = {0, 0}, {0, 0}, nil -- left: the level of what is left out here
  for _, item in ipairs(chapter.items) do
    local heading = item.block
    if heading.tag == "Header" and (heading.level == 2 or heading.level == 3) then
      local title = plain(heading)
      local number = chapter.number and chapter.number .. "." .. counted(all, heading.level)
      if left and heading.level <= left then left = nil end
      local why = not left and reason(number, stringify(heading), item.needs)
      if why then
        left = heading.level
        if why ~= "" then
          tell(("%s: section '%s' left out (%s)"):format(chapter.name, title, why))
        end
      end
      item.off = item.off or left
      local id, count = title:gsub(" ", "-"), 1
      while chapter.ids[id] do count, id = count + 1, title:gsub(" ", "-") .. "-" .. count + 1 end
      if item.off then
        chapter.gone[id] = true
      else
        heading.attr = attributes(chapter, id)
        if chapter.number then
          heading.content:insert(1, pandoc.Str(
            chapter.number .. "." .. counted(kept, heading.level) .. "\u{2002}"))
        end
      end
    end
    item.off = item.off or left
  end
end

-- 3. Captions, formulas and tables.

local function caption_of(block)
  if block.tag ~= "Para" then return end
  local kind, label = (plain(block) .. " "):match "^(%u%l+) ([%dA-Z][%d.]*)%.%s"
  if kind == "Figure" or kind == "Table" then return kind:lower(), label end
end

local function is_picture(block)
  return block and (block.tag == "RawBlock" or (block.tag == "Para" or block.tag == "Plain") and #block.content == 1
    and (block.content[1].tag == "Image" or block.content[1].tag == "RawInline"))
end

local function renumbered(content, label, number)
  local done
  return content:walk{Str = function(str)
    local first, last = str.text:find(label .. ".", 1, true)
    if done or not first then return end
    done = true
    return pandoc.Span(str.text:sub(1, first - 1) .. number .. str.text:sub(last)) -- no reference
  end}
end

local function set_target(chapter, kind, label, number)
  local id = (kind == "equation" and "eq" or kind) .. "-" .. number
  if targets[kind .. " " .. label] or chapter.ids[id] then
    refuse(("%s %s occurs twice"):format(kind, label))
  end
  if kind == "equation" or label:find "%." then
    targets[kind .. " " .. label] = {chapter = chapter, id = id, number = number}
  end
  return id
end

-- The table or the pictures at the end of `blocks`, which are removed there, with their caption.
local function captioned(chapter, blocks, block, kind, label, counts)
  local above, last = pandoc.List{}, blocks[#blocks]
  while last and (kind == "figure" and is_picture(last)
    or kind == "table" and last.tag == "Table" and #above == 0) do
    above:insert(1, blocks:remove())
    last = blocks[#blocks]
  end
  if #above == 0 then
    refuse(("the caption of %s %s is not directly below a %s"):format(kind, label, kind))
  end
  counts[kind] = counts[kind] + 1
  local number = (label:match "^.*%." or "") .. counts[kind]
  local attr = attributes(chapter, set_target(chapter, kind, label, number))
  local caption = {long = {pandoc.Plain(renumbered(block.content, label, number))}}
  if kind == "table" and typst then
    above[1].caption, above[1].attr = caption, attr
    return above[1]
  end
  return pandoc.Figure(above, caption, attr)
end

-- Text that pandoc writes into a cell of Typst as a numbered list.
local function escaped(str)
  local number, rest = str.text:match "^(%d+)(%.)$"
  if typst and number then return {pandoc.Str(number), pandoc.RawInline("typst", "\\" .. rest)} end
end

-- A table with columns as wide as they must be. A row that begins with an empty cell continues the
-- group above, and a row that holds a name only is the heading of those below it.
local function grouped(tab)
  tab.colspecs = tab.colspecs:map(function(spec)
    return {spec[1] == "AlignDefault" and "AlignLeft" or spec[1], nil}
  end)
  local function is_empty(cell) return stringify(cell.contents) == "" end
  for _, body in ipairs(tab.bodies) do
    local first, groups = nil, {}
    for i, row in ipairs(body.body) do
      local cells = row.cells
      if first and is_empty(cells[1]) then
        first.row_span = first.row_span + 1
        groups.are = true
        cells:remove(1)
      else
        first = cells[1]
        groups[i] = i > 1
        if #cells > 1 and cells:filter(is_empty):at(#cells - 1) then
          cells = pandoc.List{first}
          first.col_span, first = #tab.colspecs, nil
        end
      end
      row.cells = cells
      body.body[i] = row
    end
    for i, row in ipairs(body.body) do
      if groups.are and groups[i] then
        row.classes = {"group"}
        if typst then
          for _, cell in ipairs(row.cells) do
            cell.attributes["typst:stroke"] = "(top: 0.3pt)"
          end
        end
        body.body[i] = row
      end
    end
  end
  return tab:walk{Str = escaped}
end

-- A formula for the format of the document; display formulas with their number.
local function formula(chapter, math)
  local tag = math.text:match "\\tag%*?%s*{([^{}]*)}"
  math.text = math.text:gsub("%s*\\tag%*?%s*{[^{}]*}", "", 1):gsub("^%s+", ""):gsub("%s+$", "")
  local lost = math.text:match "{array}%s*{[^}]*|"
  for _, name in ipairs(LOST) do lost = lost or math.text:match(name .. "%f[%A]") end
  if lost then refuse(("pandoc would lose %s in this formula:\n    %s"):format(lost, math.text)) end
  local wrong = pandoc.log.silence(pandoc.write, pandoc.Pandoc{pandoc.Plain{math}}, "typst")
  if #wrong > 0 then refuse("pandoc cannot convert this formula:\n    " .. math.text) end
  for _, pair in ipairs(MENDED) do math.text = math.text:gsub(pair[1], pair[2]) end
  if not typst then -- MathML by pandoc has no space beside these names
    for _, name in ipairs{"cos", "sin", "ln", "log"} do
      math.text = math.text:gsub("([%w}])%s*\\" .. name .. "%f[%A]", "%1\\,\\" .. name)
        :gsub("\\" .. name .. "%s+([%a\\])", "\\" .. name .. "\\, %1")
    end
  end
  if math.mathtype == "InlineMath" then return math end
  local attr = tag and attributes(chapter, set_target(chapter, "equation", tag, tag), {"equation"})
    or pandoc.Attr("", {"equation"})
  if typst then
    return {pandoc.RawInline("typst", ("#display(%s)["):format(tag and '"(' .. tag .. ')"' or "none")),
      math, pandoc.RawInline("typst", tag and ("]<%s>"):format(attr.identifier) or "]")}
  end
  local number = tag and pandoc.Span("(" .. tag .. ")", {class = "number"})
  return pandoc.Span({pandoc.Span({math}, {class = "keep"}), number}, attr)
end

local function answer(quote)
  if stringify(quote.content[1]) ~= "Answer" then return end
  if not typst then return pandoc.Div(quote.content, {class = "answer"}) end
  return {raw "#answer[", pandoc.Div(quote.content), raw "]"}
end

local function set_blocks(chapter)
  local counts, blocks, section = {figure = 0, table = 0}, pandoc.Blocks{}, ""
  local function mended(block)
    return pandoc.Blocks{block}:walk{Table = grouped, BlockQuote = answer,
      Math = function(math) return formula(chapter, math) end,
      Str = function(str) if str.text:find "^\\begin{" then
        refuse("a formula stands outside of $$: " .. str.text) end end}
  end
  for _, item in ipairs(chapter.items) do
    local block = item.block
    if block.tag == "Header" then
      if typst and stringify(block):find "References$" then
        blocks:insert(raw "#set text(size: 9pt)\n#set par(spacing: 0.7em, leading: 0.5em)")
      end
      section = plain(block):gsub("^.-\u{2002}", "")
    end
    place = chapter.name .. ".ipynb" .. (section ~= "" and (", section '%s'"):format(section) or "") .. ": "
    local kind, label = caption_of(block)
    if options.check then kind = nil end -- what it names is in an output
    if item.off then
      if kind then known[kind .. " " .. label] = true end
      block:walk{Math = function(math)
        known["equation " .. (math.text:match "\\tag%*?%s*{([^{}]*)}" or "")] = true end}
    elseif kind then
      local last = blocks[#blocks]
      local folded = last and last.tag == "Div" and last.classes[1] == "folded" and blocks:remove()
      blocks:insert(captioned(chapter, blocks, mended(block)[1], kind, label, counts))
      if folded then blocks:insert(folded) end
    elseif typst and block.tag == "Para" and stringify(block):find ":$" then -- stays with the next
      blocks:insert(pandoc.Div(mended(block), {["typst:sticky"] = "true"}))
    else
      blocks:extend(mended(block))
    end
  end
  chapter.blocks = blocks
end

-- 4. References and links.

local function link(kind, label, here)
  local target = targets[kind .. " " .. label]
  if target then
    return pandoc.Link(target.number, address(target.chapter, target.id, here))
  end
  local missing = label:match "^(.*)%."
  for _, chapter in ipairs(chapters) do
    if missing and chapter.number == missing and not known[kind .. " " .. label]
      and not options.check and here.name ~= "index" then -- where names of files stand
      refuse(("the text refers to %s %s, which does not exist"):format(kind, label))
    end
  end
  return pandoc.Str(label)
end

-- A word with links in place of its labels, and whether more labels may follow.
local function linked_word(text, kind, here)
  local inlines, position = pandoc.Inlines{}, 1
  while true do
    local first, last, label = text:find("%f[%w]([%dA-Z]%d*%.?%d*)%f[^%w]", position)
    if not first or (not label:find "%d" and kind ~= "appendix") then break end
    label = label:gsub("%.$", "")
    inlines:insert(pandoc.Str(text:sub(position, first - 1)))
    inlines:insert(link(kind, label, here))
    position = first + #label
  end
  local rest = text:sub(position)
  inlines:insert(pandoc.Str(rest))
  return inlines, position > 1 and (rest == "" or rest == ",")
end

local function references(inlines, here)
  local result, kind = pandoc.Inlines{}, nil
  for _, inline in ipairs(inlines) do
    local words = {inline}
    if inline.tag == "Str" and inline.text:find "\u{a0}" then
      local before, after = inline.text:match "^(.-)\u{a0}(.*)$"
      words = {pandoc.Str(before), pandoc.Str "\u{a0}", pandoc.Str(after)}
    end
    for _, word in ipairs(words) do
      local text = word.tag == "Str" and word.text
      if not text then
        if word.tag ~= "Space" and word.tag ~= "SoftBreak" then kind = nil end
        result:insert(word)
      elseif KINDS[text:lower():gsub("^%p+", "")] then
        kind = KINDS[text:lower():gsub("^%p+", "")]
        result:insert(word)
      elseif kind and text ~= "and" and text ~= "to" and text ~= "or" and text ~= "\u{a0}" then
        local links, more = linked_word(text, kind, here)
        kind = more and kind
        result:extend(links)
      else
        result:insert(word)
      end
    end
  end
  return result
end

-- A link of the notebook: to a chapter by its file name, to a heading, or out of the report.
local function resolved(element, here)
  local name, id = element.target:match "^([^:/#]*)%.ipynb#?(.*)$"
  if not name then name, id = here.name, element.target:match "^#(.+)$" end
  if not id then
    if typst and not element.target:find "^%a+:" then return element.content end
    return element
  end
  local chapter = by_name[(name:gsub("%%20", " "))]
  if not chapter then
    tell(("%s: this report has no %s.ipynb, so '%s' is not a link"):format(
      here.name, name, stringify(element)))
    return element.content
  elseif not chapter.ids[id] then
    if not (chapter.gone[id] or options.check) then
      refuse(("the link '%s' leads to #%s, which does not exist in %s.ipynb"):format(
        stringify(element), id, name))
    end
    return element.content
  end
  element.target = address(chapter, id, here)
  return element
end

local function set_links(chapter)
  place = chapter.name .. ".ipynb: "
  local function whole(element) return element, false end
  chapter.blocks = chapter.blocks:walk{
    Link = function(element) return resolved(element, chapter) end}:walk{
    traverse = "topdown", Header = whole, Link = whole,
    Inlines = function(inlines) return references(inlines, chapter) end}
end

-- 5. The document, or pages.

local function write_pages(meta)
  local function turn(i)
    return chapters[i] and {file = chapters[i].file, title = chapters[i].heading}
  end
  for i, chapter in ipairs(chapters) do
    meta.heading, meta.pagetitle = chapter.heading, chapter.title
    meta.chapters = chapters:map(function(each)
      return {file = each.file, title = each.heading, here = each == chapter}
    end)
    meta.previous, meta.next = turn(i - 1), turn(i + 1)
    local page = pandoc.write(pandoc.Pandoc(chapter.blocks, meta), FORMAT, PANDOC_WRITER_OPTIONS)
    assert(io.open(options.folder .. "/" .. chapter.name .. ".html", "wb")):write(page):close()
  end
end

local function whole_document(meta)
  local blocks = pandoc.Blocks{}
  for _, chapter in ipairs(chapters) do
    blocks:insert(pandoc.Header(1, chapter.heading, attributes(chapter, "")))
    blocks:insert(raw "#[")
    blocks:extend(chapter.blocks)
    blocks:insert(raw "]")
  end
  for _, name in ipairs{"title", "author", "student_number", "course", "picture"} do
    meta[name] = pandoc.Inlines{pandoc.RawInline("typst", pandoc.json.encode(options[name] or ""))}
  end
  return pandoc.Pandoc(blocks, meta)
end

function Pandoc(doc)
  options = pandoc.json.decode(stringify(doc.meta.options))
  read_cells(doc.blocks)
  for _, chapter in ipairs(chapters) do
    if chapter.number and chapter.number:find "%u" then
      targets["appendix " .. chapter.number] = {chapter = chapter, id = "", number = chapter.number}
    end
    number_sections(chapter)
    set_blocks(chapter)
  end
  require_found()
  for _, chapter in ipairs(chapters) do set_links(chapter) end
  if typst then return whole_document(pandoc.Meta{}) end
  write_pages(pandoc.Meta{title = options.title})
  return pandoc.Pandoc{}
end
