
_legged() {
  local tool=$(_legged_tool "${(@)words[1,CURRENT-1]}")
  local -a found open closed
  found=("${(@f)$(_legged_candidates "${words[CURRENT]}" "${words[CURRENT-1]}" "$tool")}")
  open=(${(M)found:#*[.=]})
  closed=(${found:#*[.=]})
  if (( $#open + $#closed == 0 )); then
    if [[ -z $tool ]] && (( $+functions[_python] )); then _python; else _files; fi
    return
  fi
  compadd -S '' -- $open
  compadd -- $closed
}
compdef _legged train.py play.py legged-train legged-play python python3
