//! The style sheet of a page.

pub(crate) const PAGE_STYLE: &str = "\
:root{color-scheme:light dark}\
body{margin:0;background:#fff;color:#1d2127;font:15px/1.55 system-ui,'DejaVu Sans','Segoe UI',Helvetica,Arial,sans-serif}\
main{max-width:1000px;margin:0 auto;padding:24px 20px 60px}\
h1{font-size:26px;line-height:1.25;margin:8px 0 16px;overflow-wrap:anywhere}h2{font-size:20px;margin:38px 0 10px;padding-top:8px;border-top:1px solid #dfe3e8}\
h3{font-size:16px;margin:24px 0 6px}p{margin:8px 0}ul{margin:8px 0;padding-left:22px}\
nav ul{columns:2;list-style:none;padding:10px 14px;background:#f5f7f9;border-radius:6px;font-size:14px}\
a{color:#0063a0}figure{margin:18px 0}figure svg,img.pixels{max-width:100%;height:auto;display:block}img.pixels{image-rendering:pixelated}\
figcaption{color:#5c6470;font-size:13px;margin-top:4px}\
.slim{display:none}.take{white-space:nowrap;user-select:none}.take a{margin-left:6px;font-weight:600}\
p.lead{color:#5c6470;font-size:14px;margin:-8px 0 12px;overflow-wrap:anywhere}\
p.result{font-size:20px;line-height:1.4;font-weight:600;margin:10px 0 14px;padding:12px 16px;border-left:6px solid #9aa3ae;background:#f5f7f9;border-radius:0 8px 8px 0}\
p.sure{font-size:14px;margin:-4px 0 12px}p.result.good{border-color:#009e73;background:#eaf6f1}p.result.warning{border-color:#d99a00;background:#fdf6e3}p.result.bad{border-color:#c8372d;background:#fcecea}\
details{margin:16px 0;border-top:1px solid #dfe3e8;padding-top:8px}summary{cursor:pointer;font-weight:600;font-size:16px}\
@media(max-width:760px){.wide{display:none}.slim{display:block}.slim svg{width:100%;max-width:520px}figure .scroll svg{max-width:none}td:last-child:not(.num){min-width:15em}}\
.scroll{overflow-x:auto;margin:12px 0}table{border-collapse:collapse;font-size:13.5px}\
p.caption{color:#5c6470;font-size:13px;margin-top:4px}\
th{text-align:left;font-weight:600;border-bottom:2px solid #c3cad2;padding:4px 14px 4px 6px;vertical-align:bottom}\
td{border-bottom:1px solid #e8ebef;padding:4px 14px 4px 6px;vertical-align:top}\
td.long{overflow-wrap:anywhere}.num{text-align:right;font-variant-numeric:tabular-nums;padding:4px 8px}td.num{white-space:nowrap}\
tr.good td:first-child{color:#00724f}tr.warning td:first-child{color:#8a5a00}tr.bad td:first-child{color:#b3261e;font-weight:600}\
.note{padding:10px 14px;border-left:4px solid #9aa3ae;background:#f5f7f9;border-radius:0 6px 6px 0;margin:12px 0}\
.note.good{border-color:#009e73;background:#eaf6f1}.note.warning{border-color:#d99a00;background:#fdf6e3}.note.bad{border-color:#c8372d;background:#fcecea}\
pre{background:#f5f7f9;padding:10px 14px;border-radius:6px;overflow-x:auto;font-size:13px;line-height:1.4}\
@media (prefers-color-scheme:dark){\
body{background:#14171b;color:#e4e7eb}h2{border-color:#2f353d}a{color:#6cb8ee}figcaption,p.caption,p.lead{color:#a3acb8}\
nav ul,.note,pre{background:#1e2329}th{border-color:#4a525d}td{border-color:#2a2f37}\
tr.good td:first-child{color:#3ccf9f}tr.warning td:first-child{color:#f0b429}tr.bad td:first-child{color:#ff8078}\
p.result{background:#1e2329}details{border-color:#2f353d}p.result.good{background:#10281f}p.result.warning{background:#2c2410}p.result.bad{background:#301614}\
.note.good{background:#10281f}.note.warning{background:#2c2410}.note.bad{background:#301614}}\
@media(max-width:760px){p.result{font-size:17px}}\
@media print{details>*{display:block}.wide{display:block}.slim{display:none}main{max-width:none}h2{break-after:avoid}figure,table{break-inside:avoid}}";
