/* Built from web/src by 'make page'; sources ffc3830c20b0cbf50da25e2d202bdb769d6db1de4c22accabf79808597ea8b23 */
"use strict";(()=>{function D(o){let e={rays:o.length,mostSteps:0,meanSteps:0,lost:0,bounded:0};for(let t of o){let r=t&16777215;e.mostSteps=Math.max(e.mostSteps,r),e.meanSteps+=r/o.length,e.lost+=t>>24&1,e.bounded+=t>>25&1}return e}var B=(o,e)=>o[0]*e[0]+o[1]*e[1]+o[2]*e[2],b=(o,e,t=1)=>[o[0]+t*e[0],o[1]+t*e[1],o[2]+t*e[2]],E=(o,e)=>[e*o[0],e*o[1],e*o[2]],z=(o,e)=>[o[1]*e[2]-o[2]*e[1],o[2]*e[0]-o[0]*e[2],o[0]*e[1]-o[1]*e[0]],M=o=>E(o,1/(Math.hypot(...o)||1));function ye(o,e,t){let[r,n]=[Math.cos(t),Math.sin(t)];return b(b(E(o,r),z(e,o),n),e,B(e,o)*(1-r))}var Ke=Math.cos(3*Math.PI/180),$=class{constructor(e){this.opening=e;this.target=[0,0,0];this.up=[0,0,1];this.offset=[0,-1,0];this.fov=.9;this.reset()}reset(){this.target=this.opening.target,this.up=M(this.opening.up),this.offset=b(this.opening.eye,this.opening.target,-1),this.fov=this.opening.fov*Math.PI/180}turn(e,t){let r=ye(this.offset,this.up,-e),n=M(z(this.up,r)),i=ye(r,n,-t),a=Math.abs(B(i,this.up))/Math.hypot(...i);(a<Ke||a<Math.abs(B(r,this.up))/Math.hypot(...r))&&(r=i),this.offset=r}zoom(e){let t=Math.hypot(...this.offset)*e;this.offset=E(M(this.offset),Math.min(Math.max(t,.02),50))}pan(e,t){let r=2*Math.hypot(...this.offset)*Math.tan(this.fov/2),n=this.view(1,1);this.target=b(b(this.target,n.right,-e*r),n.down,-t*r)}view(e,t,r=0,n=0){let i=[Math.max(e-r,1),Math.max(t-n,1)],a=M(E(this.offset,-1)),s=M(z(a,this.up)),c=.5*Math.min(...i)/Math.tan(this.fov/2);return{eye:b(this.target,this.offset),right:s,down:z(a,s),forward:a,lens:[c,c,i[0]/2,i[1]/2],width:e,height:t}}};async function ge(o,{box:e},t,r){let{center:n,size:i}=e,[a,s,c]=r.worldToCamera.slice(0,3).map(U=>U.slice(0,3)),l=r.worldToCamera.slice(0,3).map(U=>U[3]),f=b(b(E(a,-l[0]),s,-l[1]),c,-l[2]),{width:u,height:d,fx:h,fy:g,cx:N,cy:_}=r,P={eye:E(b(f,n,-1),1/i),right:a,down:s,forward:c,lens:[h,g,N,_],width:u,height:d},T=r.clip,me=T?.slice(0,3),Xe=T?[...E(me,i),B(me,n)+T[3]]:null,V=o.target(u,d);try{let U=r.background??t.background;return o.draw(V,P,{...t,background:U,clip:Xe},{first:0,last:d}),{pixels:je(await V.pixels()),audit:D(await V.records())}}finally{V.delete()}}function je(o){let e=[];for(let t=0;t<o.length;t+=32768)e.push(String.fromCharCode(...o.subarray(t,t+32768)));return btoa(e.join(""))}var y=class extends Error{constructor(){super("The graphics card has given up on this picture; ask again.")}};var be=40,Ye=50,Qe=150,ve=[1,.7,.5,.35,.25,.18,.125,.09],Ze=4096,Je=8,et=512,q=class{constructor(e,t,r){this.place=e;this.orbit=t;this.look=r;this.quality=1;this.covered=[0,0];this.onFinished=()=>{};this.onFirst=()=>{};this.renderer=null;this.reasons=[];this.scale=3;this.coarse=null;this.fine=null;this.isBusy=!1;this.isDirty=!0;this.changed=0;this.rows=0;this.bandBlocks=4;this.spent=0;this.isScheduled=!1;this.wasShown=!1;this.waiting=[];new ResizeObserver(()=>this.change()).observe(e)}use(e,t){this.renderer=e,this.reasons=t,this.coarse=this.fine=null,this.isBusy=!1,this.place.replaceChildren(e.canvas),this.change()}change(){this.isDirty=!0,this.rows=0,this.spent=0,this.changed=performance.now(),this.schedule()}async picture(){(!this.fine||this.rows<this.fine.height||this.isBusy)&&await this.nextFine();let{width:e,height:t}=this.fine,r=await this.fine.pixels().catch(()=>null);if(!r)return this.nextFine().then(()=>this.picture());let n=document.createElement("canvas");n.width=Math.max(Math.round((1-this.covered[0])*e),1),n.height=Math.max(Math.round((1-this.covered[1])*t),1);let i=new ImageData(new Uint8ClampedArray(r),e,t);return n.getContext("2d").putImageData(i,0,0),new Promise(a=>n.toBlob(a))}nextFine(){return new Promise(e=>this.waiting.push(e))}schedule(){this.isScheduled||(this.isScheduled=!0,requestAnimationFrame(()=>{this.isScheduled=!1,this.renderer&&!this.isBusy&&this.advance(this.renderer)}))}advance(e){let{clientWidth:t,clientHeight:r}=this.place;!t||!r||(this.isDirty?(this.isDirty=!1,this.work(e,this.drawCoarse(e))):performance.now()-this.changed<Qe?this.schedule():(!this.fine||this.rows<this.fine.height)&&this.work(e,this.drawBand(e)))}async work(e,t){this.isBusy=!0;try{await t}catch(r){if(!(r instanceof y))throw r;return}e===this.renderer&&(this.isBusy=!1,this.schedule())}async drawCoarse(e){let{canvas:t}=e,[r,n]=this.sizeAt(1);(t.width!==r||t.height!==n)&&([t.width,t.height]=[r,n]);let i=this.view(ve[this.scale]),a=this.coarse=we(e,this.coarse,i),s=performance.now();if(e.draw(a,i,this.look,{first:0,last:i.height}),e.present(a),await e.finished(),e!==this.renderer)return;let c=performance.now()-s;c>1.5*be&&(this.scale=Math.min(this.scale+1,ve.length-1)),c<.55*be&&(this.scale=Math.max(this.scale-1,0)),this.wasShown||(this.wasShown=!0,this.onFirst())}async drawBand(e){let t=this.view(this.quality),r=this.fine=we(e,this.fine,t),n={first:this.rows,last:Math.min(this.rows+Je*this.bandBlocks,t.height)},i=performance.now();if(e.draw(r,t,this.look,n),this.rows=n.last,await e.finished(),e!==this.renderer)return;let a=performance.now()-i;this.spent+=a;let s=Math.min(Math.max(Ye/Math.max(a,1),.5),2);if(this.bandBlocks=Math.min(Math.max(Math.round(this.bandBlocks*s),1),et),this.isDirty||this.rows<t.height)return;e.present(r);let c=D(await r.records());if(this.isDirty||e!==this.renderer)return;let{width:l,height:f}=r;this.onFinished({by:[e.name,...this.reasons],width:l,height:f,milliseconds:this.spent,audit:c});for(let u of this.waiting.splice(0))u()}view(e){let[t,r]=this.sizeAt(e);return this.orbit.view(t,r,this.covered[0]*t,this.covered[1]*r)}sizeAt(e){let{clientWidth:t,clientHeight:r}=this.place,n=Math.min(e*window.devicePixelRatio,Ze/Math.max(t,r));return[Math.max(1,Math.round(t*n)),Math.max(1,Math.round(r*n))]}};function we(o,e,{width:t,height:r}){return e&&e.width===t&&e.height===r?e:(e?.delete(),o.target(t,r))}var W=o=>o instanceof Error?o.message:String(o);function p(o,e={},...t){let r=Object.assign(document.createElement(o),e);return r.append(...t),r}function v(o,...e){return p("label",{className:"row"},p("span",{},o),...e)}function ne(o,e,t,r){let n=p("input",{type:"range"});return Object.assign(n,{min:String(o),max:String(e),step:String((e-o)/400)}),n.value=String(t),n.addEventListener("input",()=>r(Number(n.value))),n}function oe(o,e,t){let r=p("select",{},...o.map(n=>p("option",{},n)));return r.selectedIndex=e,r.addEventListener("change",()=>t(r.selectedIndex)),r}function ie(o,e){let t=p("input",{type:"checkbox",checked:o});return t.addEventListener("change",()=>e(t.checked)),t}function H(o,e){let t=p("input",{type:"color",value:S(o)});return t.addEventListener("input",()=>e(tt(t.value))),t}function S(o){return`#${o.map(t=>Math.round(255*Math.min(Math.max(t,0),1))).map(t=>t.toString(16).padStart(2,"0")).join("")}`}function tt(o){let[e,t,r]=[1,3,5].map(n=>parseInt(o.slice(n,n+2),16)/255);return[e,t,r]}function k(o){let e=Math.abs(o);return e!==0&&(e<.001||e>=1e6)?o.toExponential(2):String(Number(o.toPrecision(e>=1e3?6:3)))}function x(o){return String(Math.round(o)).replace(/\B(?=(\d{3})+$)/g,"\u202F")}var X=Math.PI/24;function xe(o,e,t){let r=new Map;o.addEventListener("pointerdown",n=>{o.setPointerCapture(n.pointerId),r.set(n.pointerId,[n.clientX,n.clientY]),o.classList.add("held")});for(let n of["pointerup","pointercancel"])o.addEventListener(n,i=>{r.delete(i.pointerId),r.size||o.classList.remove("held")});o.addEventListener("pointermove",n=>{let i=r.get(n.pointerId);if(!i)return;let a=Math.min(o.clientWidth,o.clientHeight),s=[n.clientX,n.clientY],c=[(s[0]-i[0])/a,(s[1]-i[1])/a],l=[...r].find(([f])=>f!==n.pointerId)?.[1];if(l){e.pan(c[0]/2,c[1]/2);let f=u=>Math.hypot(u[0]-l[0],u[1]-l[1]);e.zoom(f(i)/Math.max(f(s),1))}else n.shiftKey||n.buttons&6?e.pan(c[0],c[1]):e.turn(Math.PI*c[0],Math.PI*c[1]);r.set(n.pointerId,s),t()}),o.addEventListener("wheel",n=>{n.preventDefault();let i=n.deltaY*(n.deltaMode===1?16:n.deltaMode===2?400:1);e.zoom(Math.exp(Math.min(Math.max(i,-300),300)/600)),t()},{passive:!1}),o.addEventListener("contextmenu",n=>n.preventDefault()),o.addEventListener("keydown",n=>{let i=rt[n.key];!i||n.ctrlKey||n.metaKey||n.altKey||(n.preventDefault(),i(e),t())})}var rt={ArrowLeft:o=>o.turn(-X,0),ArrowRight:o=>o.turn(X,0),ArrowUp:o=>o.turn(0,-X),ArrowDown:o=>o.turn(0,X),"+":o=>o.zoom(.9),"=":o=>o.zoom(.9),"-":o=>o.zoom(1/.9),r:o=>o.reset(),R:o=>o.reset()};var Te=`* {
  box-sizing: border-box;
}
html,
body {
  height: 100%;
  margin: 0;
  overflow: hidden;
  font: 13px/1.45 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", sans-serif;
  color: #e8eaed;
}
.picture {
  position: fixed;
  inset: 0;
  width: 100%;
  height: 100%;
  cursor: grab;
  touch-action: none;
  outline: none;
}
.picture canvas {
  width: 100%;
  height: 100%;
  display: block;
}
.picture.held {
  cursor: grabbing;
}
.picture:focus-visible {
  box-shadow: inset 0 0 0 2px #7cc4ff;
}
#poster {
  z-index: 1;
  pointer-events: none;
  transition: opacity 0.25s;
}
#poster.gone {
  opacity: 0;
}
.panel {
  position: fixed;
  z-index: 2;
  top: 14px;
  right: 14px;
  width: 296px;
  max-height: calc(100% - 28px);
  display: flex;
  flex-direction: column;
  background: rgb(22 25 30 / 0.86);
  backdrop-filter: blur(10px);
  border: 1px solid rgb(255 255 255 / 0.1);
  border-radius: 12px;
  box-shadow: 0 8px 30px rgb(0 0 0 / 0.35);
}
.panel header {
  display: flex;
  align-items: center;
  gap: 8px;
  padding: 10px 10px 10px 16px;
}
h1 {
  flex: 1;
  margin: 0;
  font-size: 14px;
  font-weight: 600;
  overflow: hidden;
  text-overflow: ellipsis;
  white-space: nowrap;
}
h2 {
  margin: 0 0 8px;
  font-size: 11px;
  font-weight: 600;
  letter-spacing: 0.06em;
  text-transform: uppercase;
  color: #9aa4b0;
}
.panel .body {
  overflow-y: auto;
}
.panel.closed {
  width: auto;
  max-width: 60%;
}
.panel.closed .body {
  display: none;
}
section {
  padding: 12px 16px;
  border-top: 1px solid rgb(255 255 255 / 0.08);
}
.row {
  display: flex;
  align-items: center;
  gap: 10px;
  min-height: 30px;
}
.row > span {
  flex: 1;
  white-space: nowrap;
}
.where {
  color: #9aa4b0;
  font-variant-numeric: tabular-nums;
}
input[type="range"] {
  width: 150px;
  margin: 0;
  accent-color: #5aa9f0;
}
input[type="checkbox"] {
  width: 16px;
  height: 16px;
  margin: 0;
  accent-color: #5aa9f0;
}
input[type="color"] {
  width: 44px;
  height: 24px;
  padding: 0;
  border: 1px solid rgb(255 255 255 / 0.2);
  border-radius: 6px;
  background: none;
  overflow: hidden;
}
input[type="color"]::-webkit-color-swatch-wrapper {
  padding: 0;
}
input[type="color"]::-webkit-color-swatch {
  border: 0;
}
:disabled {
  opacity: 0.4;
}
select,
button {
  font: inherit;
  color: inherit;
  background: rgb(255 255 255 / 0.09);
  border: 1px solid rgb(255 255 255 / 0.12);
  border-radius: 7px;
  padding: 4px 10px;
}
select {
  width: 150px;
}
select option {
  background: #22262d;
}
button {
  cursor: pointer;
}
button:hover {
  background: rgb(255 255 255 / 0.17);
}
.buttons {
  display: flex;
  gap: 8px;
  margin-top: 8px;
}
.buttons button {
  flex: 1;
}
.toggle {
  width: 28px;
  height: 26px;
  padding: 0;
  font-size: 16px;
  line-height: 1;
}
.curve {
  display: block;
  width: 264px;
  height: 132px;
  border-radius: 8px;
  background: rgb(0 0 0 / 0.35);
  touch-action: none;
}
.ends {
  display: flex;
  justify-content: space-between;
  margin: 3px 0 6px;
  color: #9aa4b0;
  font-variant-numeric: tabular-nums;
}
.hint,
.statistics p {
  margin: 0;
  color: #9aa4b0;
  font-size: 12px;
}
.failure {
  position: fixed;
  z-index: 3;
  left: 50%;
  bottom: 24px;
  transform: translateX(-50%);
  max-width: min(90%, 560px);
  margin: 0;
  padding: 12px 18px;
  border-radius: 10px;
  background: rgb(80 20 20 / 0.94);
}
@media (max-width: 699px) {
  .panel:not(.closed) {
    top: auto;
    bottom: 10px;
    left: 10px;
    right: 10px;
    width: auto;
    max-height: calc(50% - 10px);
  }
  .curve {
    width: 100%;
    height: auto;
    aspect-ratio: 2;
  }
}
`;var A=264,L=132,m=9,ot=12,j=class{constructor(e,t,r){this.original=e;this.changed=r;this.knots=[];this.chosen=-1;this.canvas=p("canvas",{className:"curve",tabIndex:0});this.picker=H([1,1,1],e=>this.paint(e));this.note=p("output");this.histogram=it(t),this.canvas.setAttribute("aria-label","Opacity of scalars: knots to drag");let n=p("button",{type:"button",textContent:"Reset"});n.addEventListener("click",()=>this.reset()),this.element=p("div",{},this.canvas,p("div",{className:"ends"},k(e.range[0]),this.note,k(e.range[1])),v("Colour of the knot",this.picker,n),p("p",{className:"hint"},"Drag knots; double-click adds or removes one."));let i=Math.max(1,window.devicePixelRatio);[this.canvas.width,this.canvas.height]=[A*i,L*i],this.canvas.getContext("2d").scale(i,i),this.listen(),this.load()}load(){let{scalar:e,opacity:t,color:r}=this.original;this.knots=e.map((n,i)=>({scalar:n,opacity:t[i],color:r[i]})),this.choose(-1)}reset(){this.load(),this.tell()}tell(){this.changed({...this.original,scalar:this.knots.map(e=>e.scalar),opacity:this.knots.map(e=>e.opacity),color:this.knots.map(e=>e.color)}),this.draw()}choose(e){this.chosen=e,this.picker.disabled=e<0,e>=0&&(this.picker.value=S(this.knots[e].color)),this.draw()}paint(e){this.chosen<0||(this.knots[this.chosen].color=e,this.tell())}listen(){let{canvas:e}=this,t=!1,r=n=>{let i=e.getBoundingClientRect();return[(n.clientX-i.left)*A/i.width,(n.clientY-i.top)*L/i.height]};e.addEventListener("pointerdown",n=>{e.setPointerCapture(n.pointerId);let[i,a]=r(n);this.choose(this.nearest(i,a)),t=this.chosen>=0}),e.addEventListener("pointermove",n=>{if(!t)return;let[i,a]=r(n);this.move(K(i),Ae(a))}),e.addEventListener("pointerup",()=>t=!1),e.addEventListener("dblclick",n=>{let[i,a]=r(n),s=this.nearest(i,a);s>=0?this.remove(s):this.insert(K(i),Ae(a))}),e.addEventListener("keydown",n=>{(n.key==="Delete"||n.key==="Backspace")&&this.remove(this.chosen)})}nearest(e,t){let[r,n]=[-1,ot];return this.knots.forEach((i,a)=>{let s=Math.hypot(Ee(i.scalar)-e,F(i.opacity)-t);s<n&&([r,n]=[a,s])}),r}move(e,t){let r=this.knots[this.chosen],[n,i]=[this.knots[this.chosen-1]?.scalar??0,this.knots[this.chosen+1]?.scalar??1];r.scalar=Math.min(Math.max(e,n),i),r.opacity=t,this.tell()}insert(e,t){let r=this.knots.filter(n=>n.scalar<=e).length;this.knots.splice(r,0,{scalar:e,opacity:t,color:this.valueAt(e).color}),this.choose(r),this.tell()}remove(e){e<0||this.knots.length<2||(this.knots.splice(e,1),this.choose(-1),this.tell())}valueAt(e){let t=this.knots.findIndex(c=>c.scalar>e);if(t<0)return this.knots[this.knots.length-1];if(t===0)return this.knots[0];let[r,n]=[this.knots[t-1],this.knots[t]],i=(e-r.scalar)/(n.scalar-r.scalar||1),a=(c,l)=>c+i*(l-c),s=r.color.map((c,l)=>a(c,n.color[l]));return{scalar:e,opacity:a(r.opacity,n.opacity),color:s}}draw(){let e=this.canvas.getContext("2d");e.clearRect(0,0,A,L);let t=L-m,r=(A-2*m)/this.histogram.length;e.fillStyle="rgb(255 255 255 / 0.13)",this.histogram.forEach((n,i)=>{e.fillRect(m+i*r,t-n*(t-m),r,n*(t-m))});for(let n=m;n<A-m;n++){let i=this.valueAt(K(n+.5));e.fillStyle=`${S(i.color)}d0`,e.fillRect(n,F(i.opacity),1,t-F(i.opacity)),e.fillStyle=S(i.color),e.fillRect(n,t,1,m-2)}e.strokeStyle="rgb(255 255 255 / 0.85)",e.lineWidth=1.5,e.beginPath();for(let n=m;n<=A-m;n++)e.lineTo(n,F(this.valueAt(K(n)).opacity));e.stroke(),this.knots.forEach((n,i)=>{e.beginPath(),e.arc(Ee(n.scalar),F(n.opacity),i===this.chosen?6.5:5,0,7),e.fillStyle=S(n.color),e.fill(),e.strokeStyle=i===this.chosen?"#7cc4ff":"#fff",e.lineWidth=i===this.chosen?2.5:1.5,e.stroke()}),this.note.textContent=this.chosen<0?"":this.describe(this.knots[this.chosen])}describe(e){let[t,r]=this.original.range;return`${k(t+e.scalar*(r-t))}: opacity ${k(e.opacity)}`}},Ee=o=>m+o*(A-2*m),K=o=>Math.min(Math.max((o-m)/(A-2*m),0),1),F=o=>L-m-Math.sqrt(o)*(L-2*m),Ae=o=>Math.min(Math.max((L-m-o)/(L-2*m),0),1)**2;function it(o){let e=new Array(66).fill(0);for(let r=3;r<o.length;r+=4)o[r]>=0&&o[r]<=1&&e[Math.min(65,Math.floor(o[r]*66))]++;let t=Math.max(1,...e);return e.map(r=>Math.sqrt(r/t))}var at=[.5,1,2],Le=["x","y","z"],Re=700,st=324;function Pe(o,e,t){let{header:r}=o,n=p("div",{className:"body"});if(r.transfer){let f=new j(r.transfer,o.values,u=>{e.look.transfer=u,e.change()});n.append(ae(r.scalar??"Scalar",f.element))}n.append(ae("Picture",...ct(o,e,t)),ae("Cut",...lt(o,e))),n.append(ft(o,e));let i=p("button",{type:"button",className:"toggle",title:"Show or hide the panel"}),a=p("h1",{},r.title),s=p("aside",{className:"panel"},p("header",{},a,i),n),c=f=>{s.classList.toggle("closed",!f),i.textContent=f?"\u2212":"+",i.setAttribute("aria-expanded",String(f)),l()},l=()=>{let f=window.innerWidth>=Re,u=!s.classList.contains("closed");e.covered=u?f?[st/window.innerWidth,0]:[0,.5]:[0,0],e.change()};return window.addEventListener("resize",l),i.addEventListener("click",()=>c(s.classList.contains("closed"))),c(window.innerWidth>=Re),s}function ae(o,...e){return p("section",{},p("h2",{},o),...e)}function ct(o,e,t){let{look:r}=e,n=d=>h=>{d(h),e.change()},i=ne(-3,3,0,n(d=>r.density=2**d)),s=oe(["Fast","Normal","Fine"],1,n(d=>e.quality=at[d])),c=H(r.background,n(d=>r.background=d));c.addEventListener("input",()=>document.documentElement.style.background=c.value);let l=[v("Density",i),v("Quality",s),v("Background",c)];if(o.harmonics){let d=ie(!0,n(h=>r.directional=h));l.push(v("Colour by direction",d))}let f=p("button",{type:"button",textContent:"Reset view"});f.addEventListener("click",()=>{t.reset(),e.change()});let u=p("button",{type:"button",textContent:"Save picture"});return u.addEventListener("click",async()=>{let d=await e.picture();if(!d)return;let h=URL.createObjectURL(d);p("a",{href:h,download:`${o.header.title}.png`}).click(),URL.revokeObjectURL(h)}),[...l,p("div",{className:"buttons"},f,u)]}function lt({header:{box:o}},e){let t={axis:-1,place:0,isFlipped:!1},r=ne(-.5,.5,0,c=>a({place:c})),n=p("output",{className:"where"}),i=ie(!1,c=>a({isFlipped:c})),a=c=>{Object.assign(t,c),r.disabled=i.disabled=t.axis<0;let l=t.isFlipped?1:-1,f=Le.map((u,d)=>d===t.axis?l:0);n.textContent=t.axis<0?"":k(o.center[t.axis]+o.size*t.place),e.look.clip=t.axis<0?null:[f[0],f[1],f[2],-l*t.place],e.change()},s=oe(["Nothing",...Le.map(c=>`Across ${c}`)],0,c=>a({axis:c-1}));return r.disabled=i.disabled=!0,[v("Cut away",s),v("Place",n,r),v("Other side",i)]}function ft(o,e){let{header:t}=o,r=p("p",{className:"drawn"},"\u2026");e.onFinished=i=>{r.replaceChildren(...ut(i).flatMap(a=>[a,p("br")]))};let n=`${x(t.cells)} cells, ${x(t.vertices)} vertices`;return p("section",{className:"statistics"},p("p",{},n),r)}function ut({by:o,width:e,height:t,milliseconds:r,audit:n}){return[`${e} \xD7 ${t} pixels in ${x(r)} ms`,`${x(n.meanSteps)} cells a ray, at most ${x(n.mostSteps)}`,`${x(n.lost)} rays lost, ${x(n.bounded)} ended at ${x(16384)} cells`,`Drawn by ${o.join(". ")}`]}function dt(o,e,t,r){let n=[-.4886025119029199*e,.4886025119029199*t,-.4886025119029199*o];if(r<2)return n;let[i,a,s]=[o*o,e*e,t*t];return n.push(1.0925484305920792*o*e,-1.0925484305920792*e*t,.31539156525252005*(2*s-i-a),-1.0925484305920792*o*t,.5462742152960396*(i-a)),r<3||n.push(-.5900435899266435*e*(3*i-a),2.890611442640554*o*e*t,-.4570457994644658*e*(4*s-i-a),.3731763325901154*t*(2*s-3*i-3*a),-.4570457994644658*o*(4*s-i-a),1.445305721320277*t*(i-a),-.5900435899266435*o*(i-3*a)),n}function ke(o,e,t,r,n,i){let a=t.length/3,s=r.length/a;for(let c=0;c<a;c++){let l=t[3*c]-i[0],f=t[3*c+1]-i[1],u=t[3*c+2]-i[2],d=1/(Math.hypot(l,f,u)||1),h=dt(l*d,f*d,u*d,n),[g,N,_]=[e[4*c],e[4*c+1],e[4*c+2]];for(let P=0,T=c*s;P<h.length;P++,T+=3)g+=h[P]*r[T],N+=h[P]*r[T+1],_+=h[P]*r[T+2];o[4*c]=Math.max(g,0),o[4*c+1]=Math.max(N,0),o[4*c+2]=Math.max(_,0)}}var ce=144,O=class{constructor(e,t){this.volume=e;this.seen=null;this.seenBy="";this.transfer=null;this.nodeCount=t.nodes.length/8,this.places=e.harmonics?ht(e):null}next(e,t,r){let n={},i=this.colorsFor(e.eye,t.directional);return i&&(n.colors=i),t.transfer&&t.transfer!==this.transfer&&(n.knots=pt(t.transfer)),this.transfer=t.transfer,{block:this.blockOf(e,t,r),tables:n}}blockOf({eye:e,right:t,down:r,forward:n,lens:i,width:a,height:s},c,l){let f=new ArrayBuffer(ce),u=new Float32Array(f);[e,t,r,n,i,c.clip??[],c.background].forEach((h,g)=>u.set(h,4*g)),u[28]=c.density;let d=c.transfer?.scalar.length??0;return new Int32Array(f).set([this.nodeCount,d,16384,a,s,l.first,l.last],29),f}colorsFor(e,t){let{header:r,harmonics:n,values:i}=this.volume,a=n&&t?e.join():"";return this.seen&&a===this.seenBy?null:(this.seenBy=a,r.kind==="scalar"&&r.location==="vertex"?this.seen=new Float32Array(4):(this.seen??(this.seen=i.slice()),a?ke(this.seen,i,this.places,n.coefficients,n.degree,e):this.seen.set(i),this.seen))}};function pt(o){let e=new Float32Array(8*o.scalar.length);return o.scalar.forEach((t,r)=>{e[8*r]=t,e.set([...o.color[r],o.opacity[r]*o.density],8*r+4)}),e}function ht(o){let{header:e,positions:t,cells:r}=o;if(e.location==="vertex")return t;let n=new Float32Array(3*e.cells);return r.forEach((i,a)=>{for(let s=0;s<3;s++)n[3*(a>>2)+s]+=t[3*i+s]/4}),n}function Se(o,e){let t=e.length/5,r=new Float64Array(t);for(let s=0;s<t;s++)r[s]=yt(o,e,s);let n=Uint32Array.from(r.keys()).sort((s,c)=>r[s]-r[c]),i=new Uint32Array(8*t);n.forEach((s,c)=>i.set(e.subarray(5*s,5*s+5),8*c));let a=[];return t&&le(a,o,i,0,t),{nodes:Float32Array.from(a),faces:i}}function le(o,e,t,r,n){let i=o.length;o.push(0,0,0,0,0,0,0,-1);let a;if(n-r<=3)a=mt(e,t,r,n),o[i+7]=8*r+(n-r);else{let s=r+n>>1,c=le(o,e,t,r,s),l=le(o,e,t,s,n);a=c.map((f,u)=>u<3?Math.min(f,l[u]):Math.max(f,l[u]))}for(let s=0;s<3;s++)o[i+s]=a[s],o[i+4+s]=a[3+s];return o[i+3]=o.length/8,a}function mt(o,e,t,r){let n=[1/0,1/0,1/0,-1/0,-1/0,-1/0];for(let i=t;i<r;i++)for(let a=0;a<3;a++)for(let s=0;s<3;s++){let c=o[3*e[8*i+a]+s];n[s]=Math.min(n[s],c-4e-6),n[3+s]=Math.max(n[3+s],c+4e-6)}return n}function yt(o,e,t){let r=0,n=[0,1,2].map(i=>{let a=0;for(let s=0;s<3;s++)a+=o[3*e[5*t+s]+i];return Math.min(1023,Math.max(0,Math.floor((a/3+.5)*1024)))});for(let i=9;i>=0;i--)for(let a of n)r=2*r+(a>>i&1);return r}var gt=[[1,3,2],[0,2,3],[0,3,1],[0,1,2]],bt=[[1,2,3],[0,2,3],[0,1,3],[0,1,2]];function Oe(o,e){let t=o.length,r=new Uint32Array(2*t).fill(4294967295),n=2**Math.ceil(Math.log2(2*t)),i=new Int32Array(n).fill(-1),a=(c,l)=>o[(c&-4)+bt[c&3][l]],s=0;for(let c=0;c<t;c++){let[l,f,u]=[a(c,0),a(c,1),a(c,2)],d=vt(l,f,u)&n-1;for(;i[d]>=0;d=d+1&n-1){let g=i[d];if(a(g,0)===l&&a(g,1)===f&&a(g,2)===u)break}let h=i[d];h<0?(i[d]=c,s++):(r.set([h>>2,o[h]],2*c),r.set([c>>2,o[c]],2*h),s--)}return{links:r,boundary:wt(o,e,r,s)}}function vt(o,e,t){let r=Math.imul(o,2654435761)^Math.imul(e,2246822507)^Math.imul(t,3266489909);return r^=r>>>15,r=Math.imul(r,739982445),(r^r>>>13)>>>0}function wt(o,e,t,r){let n=new Uint32Array(5*r),i=0;for(let a=0;a<o.length;a++){if(t[2*a]!==4294967295)continue;let s=a>>2,[c,l,f]=gt[a&3].map(u=>o[4*s+u]);n.set(e[s]?[c,f,l,o[a],s]:[c,l,f,o[a],s],5*i++)}return n}var w={vertices:"vec4f",colors:"vec4f",links:"vec2u",faces:"vec4u",nodes:"vec4f",knots:"vec4f"},Y=o=>Number(w[o][3]);function Q({header:o,positions:e,cells:t,odd:r,values:n}){let i=Oe(t,r),a=Se(e,i.boundary),s=new Float32Array(4*o.vertices);for(let c=0;c<o.vertices;c++)s.set(e.subarray(3*c,3*c+3),4*c),o.location==="vertex"&&(s[4*c+3]=n[4*c+3]);return{vertices:s,links:i.links,faces:a.faces,nodes:a.nodes}}var xt={f:"",i:"i",u:"u"},Tt={f32:"float",i32:"int",u32:"uint"},Ue=["float","int"].map(o=>`${o} select(${o} no, ${o} yes, bool which) { return which ? yes : no; }`).join(`
`);function fe(o){return o.replace(/\/\/.*/g,"").replace(/\bvec([234])([fiu])\b/g,(e,t,r)=>`${xt[r]}vec${t}`).replace(/\b[fiu]32\b/g,e=>Tt[e]).replace(/\bfn (\w+)\((.*?)\) -> (\w+)/g,(e,t,r,n)=>`${n} ${t}(${r.replace(/(\w+): (\w+)/g,"$2 $1")})`).replace(/\bstruct \w+ \{[^}]*\}/g,e=>`${e.replace(/(\w+): (\w+),/g,"$2 $1;")};`).replace(/\bconst (\w+): (\w+)/g,"const $2 $1").replace(/\b(?:let|var) (\w+): (\w+)/g,"$2 $1")}var C=`// What is the same for all rays of a picture; frames.ts fills it in.
struct Frame {
  eye: vec4f,
  right: vec4f,
  down: vec4f,
  forward: vec4f,
  lens: vec4f,        // fx, fy, cx, cy in pixels
  clip: vec4f,        // half-space that is seen; all zero: everything
  background: vec4f,  // linear RGB
  density: f32,       // factor of all densities
  nodeCount: i32,
  knotCount: i32,
  mostSteps: i32,
  width: i32,
  height: i32,
  firstRow: i32,      // rows that are drawn, from the top
  lastRow: i32,
}
`;var Me=`// Linear density and linear colour along a crossing, integrated exactly: see difftetvr/optics/special.py, of which
// this is the float32 version; its constants come with the page (see constants.ts).

// (w0, w1, T1) of a crossing whose optical depth would be first at its first density, last at its last.
fn weightsOf(first: f32, last: f32) -> vec3f {
  let a: f32 = min(first, 1e18);
  let b: f32 = min(last, 1e18);
  let tau: f32 = 0.5 * (a + b);
  let v: f32 = 0.5 * (b - a);
  if (tau > THIN) {
    let root: f32 = sqrt(max(a * a + 4.0 * VISIBLE * v, 0.0));
    let reach: f32 = select(1.0, 2.0 * VISIBLE / (a + root), tau > VISIBLE);
    let m0: f32 = reach * quadrature(-a * reach, -v * reach * reach);
    let transmittance: f32 = exp(-tau);
    return vec3f(1.0 - m0, m0 - transmittance, transmittance);
  }
  let square: f32 = tau * tau;
  let h: f32 = hOf(tau);
  let sine: f32 = tau * sinhOf(square);
  let q: f32 = square * pOf(square) - 2.0 * v * uOf(square, v);
  return vec3f(h * (sine + q), h * (sine - q), 1.0 - 2.0 * h * sine);
}

struct Light {
  color: vec3f,
  transmittance: f32,
}

// What is left and added behind a piece; c0 and c1 are linear RGB and density at its ends.
fn absorbed(light: Light, depth: f32, c0: vec4f, c1: vec4f) -> Light {
  let a: f32 = depth * c0.w;
  let b: f32 = depth * c1.w;
  if (!(a + b > 0.0)) {
    return light;
  }
  let w: vec3f = weightsOf(a, b);
  return Light(light.color + light.transmittance * (w.x * c0.xyz + w.y * c1.xyz), light.transmittance * w.z);
}
`;var Be=`// Scalars through a piecewise-linear transfer function, cut at its knots: see
// difftetvr/rendering/traversal/transfer.py.

fn knotAt(index: i32) -> f32 {
  return knotsAt(u32(2 * index)).x;
}

fn opticsAt(index: i32) -> vec4f {
  return knotsAt(u32(2 * index + 1));
}

// Last knot below a scalar, or at it where inclusive; -1 where there is none.
fn intervalOf(scalar: f32, inclusive: bool) -> i32 {
  var low: i32 = 0;
  var high: i32 = frame.knotCount;
  while (low < high) {
    let middle: i32 = (low + high) / 2;
    let knot: f32 = knotAt(middle);
    if (knot < scalar || (inclusive && knot == scalar)) {
      low = middle + 1;
    } else {
      high = middle;
    }
  }
  return low - 1;
}

fn scalarsAbsorbed(before: Light, depth: f32, f0: f32, f1: f32) -> Light {
  let rises: bool = f1 >= f0;
  let varies: bool = f1 != f0;
  let rise: f32 = select(1.0, f1 - f0, varies);
  var light: Light = before;
  var interval: i32 = intervalOf(f0, !(rises && varies));
  var x: f32 = 0.0;
  var f: f32 = f0;
  for (var piece: i32 = 0; piece <= frame.knotCount; piece++) {
    let ahead: i32 = select(interval, interval + 1, rises);
    let isKnot: bool = varies && ahead >= 0 && ahead < frame.knotCount;
    let knot: f32 = knotAt(clamp(ahead, 0, frame.knotCount - 1));
    let cuts: bool = isKnot && ((rises && knot <= f1) || (!rises && knot >= f1));
    let xEnd: f32 = select(1.0, clamp((knot - f0) / rise, x, 1.0), cuts && knot != f1);
    let fEnd: f32 = select(f1, knot, cuts);
    if (xEnd > x) {
      let lower: i32 = max(interval, 0);
      let upper: i32 = min(interval + 1, frame.knotCount - 1);
      let below: vec4f = opticsAt(lower);
      let above: vec4f = opticsAt(upper);
      let low: f32 = knotAt(lower);
      let width: f32 = knotAt(upper) - low;
      let inverse: f32 = select(0.0, 1.0 / width, width > 0.0);
      let c0: vec4f = mix(below, above, clamp((f - low) * inverse, 0.0, 1.0));
      let c1: vec4f = mix(below, above, clamp((fEnd - low) * inverse, 0.0, 1.0));
      light = absorbed(light, depth * (xEnd - x), c0, c1);
    }
    if (!cuts) {
      break;
    }
    interval += select(-1, 1, rises);
    x = xEnd;
    f = fEnd;
  }
  return light;
}
`;var Fe=`// A ray's way through the mesh, from cell to cell: see difftetvr/rendering/traversal/walk.py for the method.
//
// Which face a ray leaves through is decided by signs of edge functions, which all cells around an edge must see alike.
// There is no fused multiply-add here to make floats exact, and a compiler may use one where it pleases; so offsets
// from the ray are whole numbers of at most 24 bits, and where a float leaves the sign open, integers decide.

const NONE: u32 = 0xffffffffu;
const INFINITE: f32 = 1e30;
const STEPS_PER_UNIT: f32 = 4194304.0;  // offsets are less than 2, so whole numbers below 2^23
const OPAQUE: f32 = 5e-4;
// Of what is counted of a ray: its steps, whether it lost its way, whether it ran out of steps.
const STEPS: u32 = 0xffffffu;
const LOST: u32 = 0x1000000u;
const BOUNDED: u32 = 0x2000000u;

struct Ray {
  origin: vec3f,
  a: vec3f,
  b: vec3f,
  direction: vec3f,
}

struct Corner {
  vertex: u32,
  offset: vec2f,  // whole numbers
  t: f32,
  value: vec4f,
}

// Through a place in the picture, in pixels from its upper left corner.
fn rayThrough(place: vec2f) -> Ray {
  let inLens: vec2f = (place - frame.lens.zw) / frame.lens.xy;
  let d: vec3f = normalize(inLens.x * frame.right.xyz + inLens.y * frame.down.xyz + frame.forward.xyz);
  // Near the mesh, so that nothing is lost where the eye is far away.
  let origin: vec3f = frame.eye.xyz - dot(frame.eye.xyz, d) * d;
  let s: f32 = select(-1.0, 1.0, d.z >= 0.0);
  let inverse: f32 = -1.0 / (s + d.z);
  let xy: f32 = d.x * d.y * inverse;
  let a: vec3f = vec3f(1.0 + s * d.x * d.x * inverse, s * xy, -s * d.x);
  let b: vec3f = vec3f(xy, s + d.y * d.y * inverse, -d.y);
  return Ray(origin, a, b, d);
}

fn cornerAt(ray: Ray, vertex: u32) -> Corner {
  let record: vec4f = verticesAt(vertex);
  let away: vec3f = record.xyz - ray.origin;
  let offset: vec2f = floor(vec2f(dot(ray.a, away), dot(ray.b, away)) * STEPS_PER_UNIT + 0.5);
  var color: vec3f = vec3f(0.0);
  if (VERTEX_COLORS) {
    color = colorsAt(vertex).xyz;
  }
  return Corner(vertex, offset, dot(ray.direction, away), vec4f(color, record.w));
}

fn exactEdge(p: vec2i, q: vec2i) -> f32 {
  let pHigh: vec2i = p >> vec2u(12u);
  let qHigh: vec2i = q >> vec2u(12u);
  let pLow: vec2i = p & vec2i(4095);
  let qLow: vec2i = q & vec2i(4095);
  let low: i32 = pLow.x * qLow.y - pLow.y * qLow.x;
  let middle: i32 = pHigh.x * qLow.y + pLow.x * qHigh.y - pHigh.y * qLow.x - pLow.y * qHigh.x + (low >> 12u);
  let high: i32 = pHigh.x * qHigh.y - pHigh.y * qHigh.x + (middle >> 12u);
  return f32(high) * 16777216.0 + f32((middle & 4095) * 4096 + (low & 4095));
}

// Twice the signed area of (ray, p, q), of which the sign is exact.
fn edgeOf(p: vec2f, q: vec2f) -> f32 {
  let x: f32 = p.x * q.y;
  let y: f32 = p.y * q.x;
  let edge: f32 = x - y;
  if (abs(edge) > (abs(x) + abs(y)) * 2.4e-7) {
    return edge;
  }
  return exactEdge(vec2i(p), vec2i(q));
}

// Ties are broken as if the ray were shifted by (eps, eps^2), and two vertices at one place by their numbers.
fn isLeft(edge: f32, p: Corner, q: Corner) -> bool {
  if (edge != 0.0) {
    return edge > 0.0;
  }
  if (p.offset.y != q.offset.y) {
    return p.offset.y > q.offset.y;
  }
  if (p.offset.x != q.offset.x) {
    return q.offset.x > p.offset.x;
  }
  return p.vertex < q.vertex;
}

struct Face {
  p: Corner,
  q: Corner,
  r: Corner,
  edges: vec3f,  // opposite p, q, r
}

fn faceOf(p: Corner, q: Corner, r: Corner) -> Face {
  return Face(p, q, r, vec3f(edgeOf(q.offset, r.offset), edgeOf(r.offset, p.offset), edgeOf(p.offset, q.offset)));
}

fn holdsRay(face: Face) -> bool {
  return isLeft(face.edges.x, face.q, face.r) && isLeft(face.edges.y, face.r, face.p) &&
         isLeft(face.edges.z, face.p, face.q);
}

fn weightsOn(face: Face) -> vec3f {
  let sum: f32 = face.edges.x + face.edges.y + face.edges.z;
  if (sum > 0.0) {
    return max(face.edges, vec3f(0.0)) / sum;
  }
  return vec3f(1.0, 0.0, 0.0);
}

fn distanceTo(face: Face) -> f32 {
  return dot(weightsOn(face), vec3f(face.p.t, face.q.t, face.r.t));
}

fn valueOn(face: Face) -> vec4f {
  let w: vec3f = weightsOn(face);
  return w.x * face.p.value + w.y * face.q.value + w.z * face.r.value;
}

fn boundaryFace(ray: Ray, index: i32) -> Face {
  let record: vec4u = facesAt(u32(2 * index));
  return faceOf(cornerAt(ray, record.x), cornerAt(ray, record.y), cornerAt(ray, record.z));
}

fn nonZero(x: f32) -> f32 {
  return select(x, 1e-12, abs(x) < 1e-12);
}

// A boundary face through which a ray enters; -1: none.
struct Entry {
  face: i32,
  t: f32,
}

// The next one after another.
fn nextEntry(ray: Ray, before: Entry) -> Entry {
  let inverse: vec3f = 1.0 / vec3f(nonZero(ray.direction.x), nonZero(ray.direction.y), nonZero(ray.direction.z));
  var found: Entry = Entry(-1, INFINITE);
  var node: i32 = 0;
  while (node < frame.nodeCount) {
    let lower: vec4f = nodesAt(u32(2 * node));
    let upper: vec4f = nodesAt(u32(2 * node + 1));
    let x: vec3f = (lower.xyz - ray.origin) * inverse;
    let y: vec3f = (upper.xyz - ray.origin) * inverse;
    let low: vec3f = min(x, y);
    let high: vec3f = max(x, y);
    let first: f32 = max(max(low.x, low.y), low.z);
    let end: f32 = min(min(high.x, high.y), high.z);
    // Distances to boxes and to faces are rounded differently.
    let meets: bool = first <= end && end >= before.t - 1e-5 && first <= found.t + 1e-5;
    if (meets && upper.w >= 0.0) {
      let begin: i32 = i32(upper.w) / 8;
      let count: i32 = i32(upper.w) & 7;
      for (var index: i32 = begin; index < begin + count; index++) {
        let face: Face = boundaryFace(ray, index);
        if (holdsRay(face)) {
          let t: f32 = distanceTo(face);
          let isAhead: bool = t > before.t || (t == before.t && index > before.face);
          if (isAhead && (t < found.t || (t == found.t && index < found.face))) {
            found = Entry(index, t);
          }
        }
      }
    }
    node = select(i32(lower.w), node + 1, meets);
  }
  return found;
}

struct Span {
  near: f32,
  far: f32,
}

// What of the ray is looked at: what lies before the eye, on the right side of the plane.
fn spanOf(ray: Ray) -> Span {
  let eye: f32 = dot(frame.eye.xyz - ray.origin, ray.direction);
  let slope: f32 = dot(frame.clip.xyz, ray.direction);
  let at: f32 = dot(frame.clip.xyz, ray.origin) + frame.clip.w;
  if (slope > 0.0) {
    return Span(max(eye, -at / slope), INFINITE);
  }
  if (slope < 0.0) {
    return Span(eye, -at / slope);
  }
  return Span(eye, select(INFINITE, -INFINITE, at < 0.0));
}

// Behind the part of a crossing that lies in the span.
fn crossed(light: Light, span: Span, t0: f32, v0: vec4f, t1: f32, v1: vec4f) -> Light {
  let first: f32 = max(t0, span.near);
  let end: f32 = min(t1, span.far);
  if (!(end > first)) {
    return light;
  }
  let slope: vec4f = (v1 - v0) / (t1 - t0);
  var c0: vec4f = v0;
  var c1: vec4f = v1;
  if (first > t0) {
    c0 = v0 + (first - t0) * slope;
  }
  if (end < t1) {
    c1 = v0 + (end - t0) * slope;
  }
  if (SCALARS) {
    return scalarsAbsorbed(light, (end - first) * frame.density, c0.w, c1.w);
  }
  return absorbed(light, (end - first) * frame.density, c0, c1);
}

struct Traced {
  light: Light,
  record: u32,   // see STEPS
  isOver: bool,  // whether nothing is to be seen any further
}

// From an entry to the boundary.
fn walked(ray: Ray, span: Span, entry: i32, before: Traced) -> Traced {
  var face: Face = boundaryFace(ray, entry);
  var apex: u32 = facesAt(u32(2 * entry)).w;
  var cell: u32 = facesAt(u32(2 * entry + 1)).x;
  var t0: f32 = distanceTo(face);
  var v0: vec4f = valueOn(face);
  var light: Light = before.light;
  var record: u32 = before.record;
  while ((record & STEPS) < u32(frame.mostSteps)) {
    let c: Corner = cornerAt(ray, apex);
    let to: vec3f =
        vec3f(edgeOf(face.p.offset, c.offset), edgeOf(face.q.offset, c.offset), edgeOf(face.r.offset, c.offset));
    let leftP: bool = isLeft(to.x, face.p, c);
    let leftQ: bool = isLeft(to.y, face.q, c);
    let leftR: bool = isLeft(to.z, face.r, c);
    // The apex takes the place of one corner: of the one that lies between a left and a right edge.
    var dropsP: bool = leftR && !leftQ;
    var dropsQ: bool = leftP && !leftR;
    if (!dropsP && !dropsQ && !(leftQ && !leftP)) {
      // A compiler has rounded one vertex in two ways, and the ray runs next to it: then to what is least wrong.
      record = record | LOST;
      let wrong: vec3f = max(-to.zxy, to.yzx);
      dropsP = wrong.x <= min(wrong.y, wrong.z);
      dropsQ = !dropsP && wrong.y <= wrong.z;
    }
    var dropped: u32 = face.r.vertex;
    if (dropsP) {
      dropped = face.p.vertex;
      face.edges = vec3f(face.edges.x, to.z, -to.y);
      face.p = c;
    } else if (dropsQ) {
      dropped = face.q.vertex;
      face.edges = vec3f(-to.z, face.edges.y, to.x);
      face.q = c;
    } else {
      face.edges = vec3f(to.y, -to.x, face.edges.z);
      face.r = c;
    }
    let t1: f32 = distanceTo(face);
    var v1: vec4f = vec4f(0.0);
    if (CELLS) {
      v1 = colorsAt(cell);
      v0 = v1;
    } else {
      v1 = valueOn(face);
    }
    light = crossed(light, span, t0, v0, t1, v1);
    if (light.transmittance <= OPAQUE || t1 >= span.far) {
      return Traced(light, record, true);
    }
    record++;
    // Rows of a cell are in the order of its vertices.
    let rank: u32 = u32(face.p.vertex < dropped) + u32(face.q.vertex < dropped) + u32(face.r.vertex < dropped);
    let behind: vec2u = linksAt(4u * cell + rank);
    if (behind.x == NONE) {
      return Traced(light, record, false);
    }
    cell = behind.x;
    apex = behind.y;
    t0 = t1;
    v0 = v1;
  }
  return Traced(light, record | BOUNDED, true);
}

// What is seen through a place in the picture, and how the ray fared.
fn traced(place: vec2f) -> Traced {
  let ray: Ray = rayThrough(place);
  var ends: Traced = Traced(Light(vec3f(0.0), 1.0), 0u, false);
  // The mesh lies in a ball around the origin.
  if (dot(ray.origin, ray.origin) < 0.76) {
    let span: Span = spanOf(ray);
    var entry: Entry = Entry(-1, -INFINITE);
    while (!ends.isOver) {
      entry = nextEntry(ray, entry);
      if (entry.face < 0 || entry.t >= span.far) {
        break;
      }
      ends = walked(ray, span, entry.face, ends);
    }
  }
  return ends;
}
`;function Z({location:o,kind:e,optics:t}){return[...Object.entries({CELLS:o==="cell",SCALARS:e==="scalar"}).map(([n,i])=>`const ${n}: bool = ${i};`),"const VERTEX_COLORS: bool = !CELLS && !SCALARS;",Pt(t),Me,Be,Fe].join(`
`)}function Pt({thin:o,visible:e,h:t,sinh:r,p:n,u:i,nodes:a,weights:s}){let c=a.map((f,u)=>{let d=R(f);return`${R(s[u])} * exp((curve * ${d} + slope) * ${d})`}),l=i.map(f=>G(f.map(R),"x"));return[`const THIN: f32 = ${R(o)};`,`const VISIBLE: f32 = ${R(e)};`,"// Integral of exp(slope x + curve x^2) from 0 to 1.",`fn quadrature(slope: f32, curve: f32) -> f32 { return ${c.join(" + ")}; }`,`fn hOf(x: f32) -> f32 { return ${G(t.map(R),"x")}; }`,`fn sinhOf(x: f32) -> f32 { return ${G(r.map(R),"x")}; }`,`fn pOf(x: f32) -> f32 { return ${G(n.map(R),"x")}; }`,`fn uOf(x: f32, y: f32) -> f32 { return ${G(l,"y")}; }`].join(`
`)}function R(o){let e=String(o);return/[.e]/.test(e)?e:`${e}.0`}function G(o,e){return o.reduceRight((t,r)=>`(${r} + ${e} * ${t})`)}var J=Object.keys(w),kt=`#version 300 es
void main() {
  // One triangle that covers the screen.
  gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0);
}`,St=`#version 300 es
precision highp float;
uniform sampler2D source;
uniform vec2 size;
out vec4 pixel;
void main() { pixel = vec4(texture(source, gl_FragCoord.xy / size).rgb, 1.0); }`,Ot=`#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp usampler2D;
`,Ut=`
layout(location = 0) out vec4 pixel;
layout(location = 1) out uint record;
void main() {
  Traced ends = traced(vec2(gl_FragCoord.x, float(frame.height) - gl_FragCoord.y));
  pixel = vec4(ends.light.color + ends.light.transmittance * frame.background.xyz, 1.0);
  record = ends.record;
}`;function Ce(o){return Ie(o,St)}function Ge(o,e,t){let r=Ie(o,[Ot,...J.map(n=>Mt(n,t)),Ue,fe(C),"layout(std140) uniform Block { Frame frame; };",fe(Z(e)),Ut].join(`
`));return o.useProgram(r),J.forEach((n,i)=>o.uniform1i(o.getUniformLocation(r,n),i)),o.uniformBlockBinding(r,o.getUniformBlockIndex(r,"Block"),0),r}function Mt(o,e){let t=w[o].endsWith("u")?"u":"",r=Y(o),n=`ivec2(int(index & ${2**e-1}u), int(index >> ${e}u))`;return`uniform ${t}sampler2D ${o};
${t}vec${r} ${o}At(uint index) { return texelFetch(${o}, ${n}, 0).${"xyzw".slice(0,r)}; }`}function Ie(o,e){let t=o.createProgram();for(let[r,n]of[[o.VERTEX_SHADER,kt],[o.FRAGMENT_SHADER,e]]){let i=o.createShader(r);o.shaderSource(i,n),o.compileShader(i),o.attachShader(t,i),o.deleteShader(i)}if(o.linkProgram(t),!o.getProgramParameter(t,o.LINK_STATUS)){let r=(o.getAttachedShaders(t)??[]).map(n=>o.getShaderInfoLog(n));throw new Error(`The shaders of this page do not compile here: ${r.join(" ")} ${o.getProgramInfoLog(t)}`)}return t}var ee=class{constructor(e,t,r){this.gl=e;this.width=t;this.height=r;this.frame=e.createFramebuffer(),e.bindFramebuffer(e.FRAMEBUFFER,this.frame),this.color=this.attached(0,e.RGBA8,e.LINEAR),this.traces=this.attached(1,e.R32UI,e.NEAREST),e.drawBuffers([e.COLOR_ATTACHMENT0,e.COLOR_ATTACHMENT1])}async pixels(){let{gl:e,width:t,height:r}=this,n=new Uint8Array(4*t*r);this.read(e.COLOR_ATTACHMENT0,e.RGBA,e.UNSIGNED_BYTE,n);let i=new Uint8Array(n.length);for(let a=0;a<r;a++)i.set(n.subarray(4*t*a,4*t*(a+1)),4*t*(r-1-a));return i}async records(){let{gl:e,width:t,height:r}=this,n=new Uint32Array(t*r);return this.read(e.COLOR_ATTACHMENT1,e.RED_INTEGER,e.UNSIGNED_INT,n),n}delete(){this.gl.deleteTexture(this.color),this.gl.deleteTexture(this.traces),this.gl.deleteFramebuffer(this.frame)}read(e,t,r,n){let{gl:i,width:a,height:s}=this;if(i.bindFramebuffer(i.READ_FRAMEBUFFER,this.frame),i.readBuffer(e),i.readPixels(0,0,a,s,t,r,n),i.isContextLost())throw new y}attached(e,t,r){let{gl:n}=this,i=n.createTexture();n.bindTexture(n.TEXTURE_2D,i),n.texStorage2D(n.TEXTURE_2D,1,t,this.width,this.height);for(let a of[n.TEXTURE_MIN_FILTER,n.TEXTURE_MAG_FILTER])n.texParameteri(n.TEXTURE_2D,a,r);for(let a of[n.TEXTURE_WRAP_S,n.TEXTURE_WRAP_T])n.texParameteri(n.TEXTURE_2D,a,n.CLAMP_TO_EDGE);return n.framebufferTexture2D(n.FRAMEBUFFER,n.COLOR_ATTACHMENT0+e,n.TEXTURE_2D,i,0),i}};async function de(o){let e=document.createElement("canvas"),t=e.getContext("webgl2",{antialias:!1,alpha:!1,depth:!1});if(!t)throw new Error("This browser has no WebGL 2, or it is switched off; this picture is all it can show.");return new ue(t,e,o)}var ue=class{constructor(e,t,r){this.gl=e;this.canvas=t;this.name="WebGL 2";this.textures=new Map;this.widthBits=e.getParameter(e.MAX_TEXTURE_SIZE)>=4096?12:11,this.program=Ge(e,r.header,this.widthBits),this.copying=Ce(e),this.block=e.createBuffer();let n=Q(r);this.frames=new O(r,n),this.fill(n),this.lost=new Promise(i=>{t.addEventListener("webglcontextlost",()=>{i("The graphics driver has given up on this page; load it again, with another quality.")})})}target(e,t){return new ee(this.gl,e,t)}draw(e,t,r,n){let{gl:i}=this,{block:a,tables:s}=this.frames.next(t,r,n);this.fill(s),i.useProgram(this.program),i.bindBufferBase(i.UNIFORM_BUFFER,0,this.block),i.bufferData(i.UNIFORM_BUFFER,a,i.DYNAMIC_DRAW),J.forEach((c,l)=>{i.activeTexture(i.TEXTURE0+l),i.bindTexture(i.TEXTURE_2D,this.textures.get(c)?.texture??null)}),i.activeTexture(i.TEXTURE0),i.bindFramebuffer(i.FRAMEBUFFER,e.frame),i.viewport(0,0,t.width,t.height),i.enable(i.SCISSOR_TEST),i.scissor(0,t.height-n.last,t.width,n.last-n.first),i.drawArrays(i.TRIANGLES,0,3),i.disable(i.SCISSOR_TEST)}present(e){let{gl:t}=this;t.useProgram(this.copying),t.bindFramebuffer(t.FRAMEBUFFER,null),t.viewport(0,0,t.drawingBufferWidth,t.drawingBufferHeight),t.bindTexture(t.TEXTURE_2D,e.color),t.uniform2f(t.getUniformLocation(this.copying,"size"),t.drawingBufferWidth,t.drawingBufferHeight),t.drawArrays(t.TRIANGLES,0,3),t.bindTexture(t.TEXTURE_2D,null)}finished(){let{gl:e}=this,t=e.fenceSync(e.SYNC_GPU_COMMANDS_COMPLETE,0);return e.flush(),new Promise((r,n)=>{let i=()=>{if(e.isContextLost())return n(new y);if(e.getSyncParameter(t,e.SYNC_STATUS)!==e.SIGNALED)return requestAnimationFrame(i);e.deleteSync(t),r()};requestAnimationFrame(i)})}fill(e){for(let[t,r]of Object.entries(e))this.fillTable(t,r)}fillTable(e,t){let{gl:r}=this,n=Y(e),i=2**this.widthBits,a=t.length/n,s=Math.max(1,Math.ceil(a/i));if(s>r.getParameter(r.MAX_TEXTURE_SIZE))throw new Error("This browser's textures are too small for a volume of so many cells; open it on another machine.");let[c,l,f]={vec4f:[r.RGBA32F,r.RGBA,r.FLOAT],vec2u:[r.RG32UI,r.RG_INTEGER,r.UNSIGNED_INT],vec4u:[r.RGBA32UI,r.RGBA_INTEGER,r.UNSIGNED_INT]}[w[e]];r.bindTexture(r.TEXTURE_2D,this.textureOf(e,c,i,s));let u=Math.floor(a/i),d=t.subarray(u*i*n);u&&r.texSubImage2D(r.TEXTURE_2D,0,0,0,i,u,l,f,t,0),d.length&&r.texSubImage2D(r.TEXTURE_2D,0,0,u,d.length/n,1,l,f,d,0)}textureOf(e,t,r,n){let{gl:i}=this,a=this.textures.get(e);if(a&&a.height>=n)return a.texture;a&&i.deleteTexture(a.texture);let s=i.createTexture();this.textures.set(e,{texture:s,height:n}),i.bindTexture(i.TEXTURE_2D,s),i.texStorage2D(i.TEXTURE_2D,1,t,r,n);for(let c of[i.TEXTURE_MIN_FILTER,i.TEXTURE_MAG_FILTER])i.texParameteri(i.TEXTURE_2D,c,i.NEAREST);return s}};async function Ne(o){if(!navigator.gpu)throw new Error("This browser has no WebGPU.");let e=await navigator.gpu.requestAdapter();if(!e)throw new Error("WebGPU finds no graphics card here.");if(e.info.isFallbackAdapter&&!o)throw new Error("WebGPU would compute on the CPU here.");return e}async function _e(o,e){let t=Math.max(...e.map(i=>i.byteLength)),{maxBufferSize:r,maxStorageBufferBindingSize:n}=o.limits;if(t>Math.min(r,n))throw new Error("WebGPU's buffers are too small here for a volume of so many cells.");return o.requestDevice({requiredLimits:{maxBufferSize:t,maxStorageBufferBindingSize:t}})}async function Ve(o,e){for(let r of["validation","out-of-memory"])o.pushErrorScope(r);let t=e();t.catch(()=>{});for(let r of await Promise.all([o.popErrorScope(),o.popErrorScope()]))if(r)throw new Error(`WebGPU fails here: ${r.message}`);return t}var I=8,te="rgba8unorm",De=Object.entries(w).map(([o,e],t)=>`@group(0) @binding(${t+1}) var<storage, read> ${o}: array<${e}>;
fn ${o}At(index: u32) -> ${e} { return ${o}[index]; }`),Bt=`
@group(0) @binding(0) var<uniform> frame: Frame;
@group(1) @binding(0) var pixels: texture_storage_2d<${te}, write>;
@group(1) @binding(1) var<storage, read_write> records: array<u32>;

@compute @workgroup_size(${I}, ${I})
fn trace(@builtin(global_invocation_id) id: vec3u) {
  let pixel = vec2i(id.xy) + vec2i(0, frame.firstRow);
  if (pixel.x >= frame.width || pixel.y >= frame.lastRow) {
    return;
  }
  let ends = traced(vec2f(pixel) + 0.5);
  let color = ends.light.color + ends.light.transmittance * frame.background.xyz;
  textureStore(pixels, pixel, vec4f(color, 1.0));
  records[pixel.y * frame.width + pixel.x] = ends.record;
}`,Ft=`
@group(0) @binding(0) var source: texture_2d<f32>;
@group(0) @binding(1) var smoothly: sampler;

struct Corner {
  @builtin(position) position: vec4f,
  @location(0) place: vec2f,
}

// One triangle that covers the screen.
@vertex
fn corner(@builtin(vertex_index) index: u32) -> Corner {
  let place = 2.0 * vec2f(f32(index & 1u), f32(index >> 1u));
  return Corner(vec4f(2.0 * place.x - 1.0, 1.0 - 2.0 * place.y, 0.0, 1.0), place);
}

@fragment
fn copied(@location(0) place: vec2f) -> @location(0) vec4f {
  return vec4f(textureSampleLevel(source, smoothly, place, 0.0).rgb, 1.0);
}`;async function ze(o,e,t){let r=[C,...De,Z(e),Bt].join(`
`),n=o.createShaderModule({label:"trace",code:r}),i=o.createShaderModule({label:"copy",code:Ft}),[a,s]=await Promise.all([o.createComputePipelineAsync({layout:Ct(o),compute:{module:n}}),o.createRenderPipelineAsync({layout:"auto",vertex:{module:i},fragment:{module:i,targets:[{format:t}]}})]);return{trace:a,copy:s}}function Ct(o){let e=GPUShaderStage.COMPUTE,t=[{binding:0,visibility:e,buffer:{type:"uniform"}}];De.forEach((i,a)=>t.push({binding:a+1,visibility:e,buffer:{type:"read-only-storage"}}));let n=[t,[{binding:0,visibility:e,storageTexture:{format:te}},{binding:1,visibility:e,buffer:{type:"storage"}}]].map(i=>o.createBindGroupLayout({entries:i}));return o.createPipelineLayout({bindGroupLayouts:n})}var $e=256,re=class{constructor(e,{trace:t,copy:r},n,i){this.device=e;this.width=n;this.height=i;this.color=e.createTexture({size:[n,i],format:te,usage:GPUTextureUsage.STORAGE_BINDING|GPUTextureUsage.TEXTURE_BINDING|GPUTextureUsage.COPY_SRC}),this.traces=e.createBuffer({size:4*n*i,usage:GPUBufferUsage.STORAGE|GPUBufferUsage.COPY_SRC});let a=this.color.createView(),s=e.createSampler({magFilter:"linear",minFilter:"linear"});this.outputs=e.createBindGroup({layout:t.getBindGroupLayout(1),entries:[{binding:0,resource:a},{binding:1,resource:{buffer:this.traces}}]}),this.shown=e.createBindGroup({layout:r.getBindGroupLayout(0),entries:[{binding:0,resource:a},{binding:1,resource:s}]})}async pixels(){let{width:e,height:t}=this,r=Math.ceil(4*e/$e)*$e,n=await this.read(r*t,(a,s)=>{a.copyTextureToBuffer({texture:this.color},{buffer:s,bytesPerRow:r},[e,t])}),i=new Uint8Array(4*e*t);for(let a=0;a<t;a++)i.set(new Uint8Array(n,r*a,4*e),4*e*a);return i}async records(){let{size:e}=this.traces;return new Uint32Array(await this.read(e,(t,r)=>t.copyBufferToBuffer(this.traces,0,r,0,e)))}delete(){this.color.destroy(),this.traces.destroy()}async read(e,t){let{device:r}=this,n=r.createBuffer({size:e,usage:GPUBufferUsage.MAP_READ|GPUBufferUsage.COPY_DST}),i=r.createCommandEncoder();t(i,n),r.queue.submit([i.finish()]);try{await n.mapAsync(GPUMapMode.READ)}catch{throw r.destroy(),new y}let a=n.getMappedRange().slice(0);return n.destroy(),a}};async function qe(o,e){let t=await Ne(e),r=Q(o),n=await _e(t,[...Object.values(r),o.values]);try{return await Ve(n,async()=>{let i=ze(n,o.header,navigator.gpu.getPreferredCanvasFormat()),a=new pe(n,r);return new he(n,await i,a,new O(o,r))})}catch(i){throw n.destroy(),i}}var pe=class{constructor(e,t){this.device=e;this.tables=new Map;this.group=null;this.block=this.bufferOf(ce,GPUBufferUsage.UNIFORM);let r=new Float32Array(4);for(let n of Object.keys(w))this.fillTable(n,t[n]??r)}fill(e,t){this.device.queue.writeBuffer(this.block,0,e);for(let[r,n]of Object.entries(t))this.fillTable(r,n)}bound(e){let r=[this.block,...this.tables.values()].map((n,i)=>({binding:i,resource:{buffer:n}}));return this.group??(this.group=this.device.createBindGroup({layout:e,entries:r}))}fillTable(e,t){let r=this.tables.get(e);r?.size!==t.byteLength&&(r?.destroy(),r=this.bufferOf(t.byteLength,GPUBufferUsage.STORAGE),this.tables.set(e,r),this.group=null),this.device.queue.writeBuffer(r,0,t)}bufferOf(e,t){return this.device.createBuffer({size:e,usage:t|GPUBufferUsage.COPY_DST})}},he=class{constructor(e,t,r,n){this.device=e;this.pipelines=t;this.buffers=r;this.frames=n;this.name="WebGPU";this.canvas=document.createElement("canvas");let i=this.canvas.getContext("webgpu");if(!i)throw new Error("WebGPU cannot draw on this page.");this.context=i,i.configure({device:e,format:navigator.gpu.getPreferredCanvasFormat(),alphaMode:"opaque"});let a="";e.addEventListener("uncapturederror",({error:s})=>{a||(a=s.message),e.destroy()}),this.lost=e.lost.then(({message:s})=>`WebGPU has failed: ${a||s}`)}target(e,t){return new re(this.device,this.pipelines,e,t)}draw(e,t,r,n){let{device:i,buffers:a,pipelines:s}=this,{block:c,tables:l}=this.frames.next(t,r,n);a.fill(c,l);let f=i.createCommandEncoder(),u=f.beginComputePass();u.setPipeline(s.trace),u.setBindGroup(0,a.bound(s.trace.getBindGroupLayout(0))),u.setBindGroup(1,e.outputs),u.dispatchWorkgroups(Math.ceil(t.width/I),Math.ceil((n.last-n.first)/I)),u.end(),i.queue.submit([f.finish()])}present(e){let{device:t,pipelines:r}=this,n=t.createCommandEncoder(),i=this.context.getCurrentTexture().createView(),a=n.beginRenderPass({colorAttachments:[{view:i,loadOp:"clear",storeOp:"store"}]});a.setPipeline(r.copy),a.setBindGroup(0,e.shown),a.draw(3),a.end(),t.queue.submit([n.finish()])}async finished(){try{await this.device.queue.onSubmittedWorkDone()}catch{throw new y}}};function Gt(o){return o==="#webgl"?[de]:[e=>qe(e,o==="#webgpu"),de]}var It=5e3,Nt=250;async function _t(o,e){let t=performance.now()+It;for(;;){try{return await o(e)}catch(r){if(performance.now()>t)throw r}await new Promise(r=>setTimeout(r,Nt))}}async function We(o,e,t){let r=[],n=!1;for(let i of Gt(e)){let s=await(n?_t(i,o):i(o)).catch(c=>void r.push(W(c)));s&&(t(s,[...r]),r.push(await s.lost),n=!0)}throw new Error(r[r.length-1])}async function He(o){let e=await Dt(Vt(o.trim())),t=new DataView(e.buffer,e.byteOffset).getUint32(0,!0),r=JSON.parse(new TextDecoder().decode(e.subarray(4,4+t))),n=new Map,i=4+t;for(let l of r.arrays){n.set(l.name,{entry:l,of:u=>zt(e,l,f,u)});let f=i;i+=l.rows*l.columns*l.width}let{cells:a,odd:s}=qt(r,n.get("cells"),n.get("odd")),c=n.get("harmonics");return{header:r,positions:$t(r,n.get("positions")),cells:a,odd:s,values:Wt(n),harmonics:c?Xt(c):null}}function Vt(o){let e=Uint8Array.fromBase64;if(e)return e(o);let t=atob(o),r=new Uint8Array(t.length);for(let n=0;n<t.length;n++)r[n]=t.charCodeAt(n);return r}async function Dt(o){if(typeof DecompressionStream>"u")throw new Error("This browser is too old to unpack the volume; this picture is all it can show.");let e=new Blob([o]).stream().pipeThrough(new DecompressionStream("deflate"));return new Uint8Array(await new Response(e).arrayBuffer())}function zt(o,e,t,r){let{rows:n,width:i}=e,a=new Int32Array(n);for(let s=0;s<i;s++){let c=t+(r*i+s)*n;for(let l=0;l<n;l++)a[l]|=o[c+l]<<8*s}if(e.differences){let s=0;for(let c=0;c<n;c++){let l=a[c];s+=l&1?-((l>>>1)+1):l>>>1,a[c]=s}}return a}function $t(o,e){let t=new Float32Array(3*o.vertices),r=2**e.entry.bits-1;for(let n=0;n<3;n++){let i=e.of(n),a=0;for(let s of i)a=Math.max(a,s);for(let s=0;s<i.length;s++)t[3*s+n]=(i[s]-.5*a)/r}return t}function qt(o,e,t){let r=new Uint32Array(4*o.cells),n=[0,1,2,3].map(l=>e.of(l)),i=t.of(0),a=new Uint8Array(o.cells),s=0,c=0;for(let l=0;l<o.cells;l++){let f=n[0][l];s+=f,c=(f===0&&l>0?c:s)+n[1][l];let u=c+n[2][l];r.set([s,c,u,u+n[3][l]],4*l),a[l]=i[l>>3]>>(l&7)&1}return{cells:r,odd:a}}function Wt(o){let e=o.get("scalar");if(e){let a=new Float32Array(4*e.entry.rows),s=e.of(0);for(let c=0;c<s.length;c++)a[4*c+3]=e.entry.low+e.entry.step*s[c];return a}let t=o.get("density"),r=o.get("color"),n=new Float32Array(4*t.entry.rows),i=Ht();return[r.of(0),r.of(1),r.of(2),t.of(0)].forEach((a,s)=>{let c=(s<3?r:t).entry.dropped;for(let l=0;l<a.length;l++)n[4*l+s]=i[a[l]<<c]}),n}function Ht(){let o=new Float32Array(65536);for(let e=0;e<o.length;e++){let t=e>>10&31,r=e&1023,n=t===0?r*2**-24:(1024+r)*2**(t-25);o[e]=e&32768?-n:n}return o}function Xt(o){let{rows:e,columns:t,scale:r,degree:n}=o.entry,i=new Float32Array(e*t);for(let a=0;a<t;a++){let s=o.of(a);for(let c=0;c<e;c++)i[c*t+a]=(s[c]-128)*r[a]}return{degree:n,coefficients:i}}async function Kt(){document.head.append(p("style",{textContent:Te}));let o=p("div",{className:"picture",tabIndex:0});o.setAttribute("role","img"),o.setAttribute("aria-label","The volume; drag to turn it");let e=await He(document.getElementById("volume").textContent),{header:t}=e,r=new $(t.opening),{background:n,transfer:i=null}=t,a={background:n,clip:null,density:1,directional:!0,transfer:i},s=new q(o,r,a);s.onFirst=()=>document.getElementById("poster")?.classList.add("gone"),xe(o,r,()=>s.change());let c=Pe(e,s,r);return window.addEventListener("hashchange",()=>location.reload()),We(e,location.hash,(l,f)=>{o.isConnected||document.body.append(o,c),s.use(l,f),window.difftetvr={header:t,renderer:l.name,render:u=>ge(l,t,a,u)}})}function jt(o){document.getElementById("poster")?.classList.remove("gone"),document.body.append(p("p",{className:"failure"},W(o)))}Kt().catch(jt);})();
