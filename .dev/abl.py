import os,sys,json,time
os.environ['OMP_NUM_THREADS']='1'
sys.path[:0]=['.','docs/benchmarks']
import torch; torch.set_num_threads(1)
from multiprocessing import Pool
from dataclasses import replace
OUT=os.environ.get('OUT','/tmp/w/out')
PH=("shells","virions","filaments","particles","slab"); NO=("clipped","skewed","outliers","low-dose","8-bit")
V={}
for f,vals in dict(settle=(20,80),candidate=(30,),adapt=(10,60),refine=(20,),trial=(15,60),polish=(20,80),later_rate=(0.25,1.0),offset_rate=(1.0,)).items():
    for v in vals: V[f'{f}={v}']=dict(schedule={f:v})
V['base']={}
V['slab24']=dict(slab=24)
for f,vals in dict(whole=(60,200),).items():
    for v in vals: V[f'slab24 {f}={v}']=dict(slab=24,schedule={f:v})
def job(j):
    kind,ph,no,name=j
    torch.set_num_threads(1)
    t=time.process_time()
    try:
        if kind=='acc':
            from joint_accuracy import accuracy
            r=accuracy(ph,no,size=96,tilts="-59.5:58:1.5",seed=0)
        else:
            from recon.benchmarks.scenes import make_scene
            from recon.joint.joint import JointReconstructor
            from recon.joint.plan import Schedule
            from recon.metrics.metrics import compare
            s=make_scene(64,phantom=ph,noise=no); o=dict(V[name]); sch=o.pop('schedule',{})
            x=JointReconstructor(schedule=replace(Schedule(),**sch),**o)(s.noisy)
            r=dict(v=compare(x.volume.attenuation,s.truth).psnr,p=compare(x.projections,s.clean.images).psnr,w=x.weight,n=type(getattr(x.noise_model,'model',x.noise_model)).__name__)
    except Exception as e:
        r=dict(error=repr(e))
    return dict(kind=kind,ph=ph,no=no,name=name,cpu=time.process_time()-t,**{k:v for k,v in r.items() if k not in('name',)})
if __name__=='__main__':
    what=sys.argv[1].split(',')
    jobs=[]
    if 'acc' in what: jobs+=[('acc',p,n,'') for p in PH for n in NO]
    if 'abl' in what: jobs+=[('abl',p,n,v) for v in sorted(V,key=lambda v:v!='base') for p in PH for n in NO]
    end=time.time()+float(sys.argv[2])
    with Pool(int(sys.argv[3]),maxtasksperchild=4) as pool, open(f'{OUT}/res.jsonl','a') as f:
        for r in pool.imap_unordered(job,jobs):
            f.write(json.dumps(r,default=float)+'\n'); f.flush()
            if time.time()>end: pool.terminate(); break
    print('done')
